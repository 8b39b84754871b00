"""Promises of `drivers.relay.make`."""

from typing import Any

import pytest

from cell.config.cell_config import tables_of
from tests.support.wire.other_makes import LCUS, NUMATO, refusal_of


@pytest.mark.parametrize(
    ("tables", "told"),
    [
        ((NUMATO, {"claw": {**NUMATO["claw"], "baud": 115200}}), "laser and claw are both at /dev/ttyACM1"),
        ((NUMATO, {"claw": {**NUMATO["claw"], "relay": 0}}), "laser.url and claw.url are both"),
        ((NUMATO, {"rail": {**tables_of(None)["rail"], "url": "/dev/ttyACM1"}}), "each has a port of its own"),
        (({"laser": {**LCUS["laser"], "relay": 0}},), "relays as the board counts them, from 1"),
        (({"claw": {**LCUS["laser"]}},), '"lcus" is not one of'),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_with_key_value_and_what_is_allowed(tables: tuple[dict[str, Any], ...], told: str):
    assert told in refusal_of(*tables)
