"""The rail's driver on the simulated rail's wire, its motions against the simulated carriage."""

from typing import Any

import pytest

from drivers.clock import Clock
from drivers.errors import ConfigError, InterlockError
from tests.support.wire.rail_bench import Bench, connect, telegram

pytestmark = pytest.mark.wire


@pytest.mark.parametrize("wrong", [{"travel": (0.1, 0.0)}, {"acceleration": -1.0}])
def test_impossible_parameters_are_refused_before_the_port_is_opened(wrong: dict[str, Any]):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        connect("socket://127.0.0.1:1", Clock(), **wrong)


def test_who_only_looks_sets_nothing_and_stops_nothing(homed: Bench):
    homed.rail.close()
    homed.peer.module.handle(telegram(4, 0, round(0.09 / 0.002 * 200 * 256)))
    before = homed.model.settings
    looking = connect(homed.peer.url, homed.clock, control=False)
    state = looking.state()
    assert state.moving and state.homed
    for command in (looking.home, lambda: looking.move_to(0.01), looking.stop):
        with pytest.raises(InterlockError, match="looked at only"):
            command()
    looking.close()
    assert homed.model.settings == before
    homed.clock.sleep(4.0)
    assert homed.carriage() == pytest.approx(0.09, abs=1e-5)
