"""Promises of `drivers.rail.modbus.make`."""

from __future__ import annotations

import json
from typing import Any

import pytest

from cell.config.cell_config import load_config
from drivers.errors import ConfigError
from drivers.rail.modbus.link import Number
from drivers.rail.modbus.make import register_map
from tests.support.modbus_maps import EDGES, PATHS, RAIL
from tests.support.wire.other_makes import LCUS, MODBUS, ROBOTIQ, cell


def test_a_rail_of_another_make_is_another_configuration_for_a_calibration_and_another_switch_is_none() -> None:
    """What positions mean hangs on the rail's map, where the light plane lies does not hang on the laser's switch."""
    stock = load_config(None).calibration_hash()
    with_drive = cell(MODBUS).calibration_hash()
    assert stock != with_drive
    turned = {"rail": {**MODBUS["rail"], "counts_per_turn": 4000}}
    homed_elsewhere = json.loads(json.dumps(MODBUS))
    homed_elsewhere["rail"]["registers"]["home"]["value"] = 0x21
    assert len({with_drive, cell(turned).calibration_hash(), cell(homed_elsewhere).calibration_hash()}) == 3
    witness = {"witness": "0 mm"}
    assert cell({"laser": {**LCUS["laser"], **witness}}, ROBOTIQ).calibration_hash() == stock


def registers(**changed: Any) -> dict[str, Any]:
    return {"rail": {**RAIL, "registers": {**PATHS, **changed}}}


def test_the_map_of_a_drive_reaches_the_driver_as_it_is_written() -> None:
    made = register_map(cell({"rail": {**RAIL, "registers": EDGES}}).rail.registers)  # type: ignore[attr-defined]
    assert made.position == Number(0x00CC, 2, True, False)
    assert made.start.writes == [8, 0]
    assert made.moving.decode(0) and not made.moving.decode(1 << 5)


@pytest.mark.parametrize(
    ("tables", "told"),
    [
        ((registers(alarm={"address": 0x6203, "words": 1}),), "speed and alarm both use register 0x6203"),
        ((registers(target={"address": 0x6201, "input": True}),), "input registers cannot be written"),
        ((registers(moving={"address": 0x1003, "bit": 16}),), "16 is outside the allowed range (allowed: 0 to 15)"),
        ((registers(home={"address": 70000, "value": 1}),), "70000 is outside the allowed range (allowed: 0 to 65535)"),
        ((registers(speed={"address": 0x6203, "unit": "mm/s"}),), '"mm/s" is not one of "counts/s"'),
        ((registers(position={"address": 0x602C, "words": 1}),), "the drive's registers count to 32767"),
        (({"rail": {key: value for key, value in RAIL.items() if key != "registers"}},), "rail.registers: missing"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_with_key_value_and_what_is_allowed(
    tables: tuple[dict[str, Any], ...], told: str
) -> None:
    with pytest.raises(ConfigError) as met:
        cell(*tables)
    assert told in str(met.value)
