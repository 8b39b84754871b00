"""Which way and how far a rail goes is judged by its camera, its switches by what they do."""

from contextlib import closing

import numpy as np
import pytest

from cell.apps.commission.check import Result
from cell.apps.commission.checks.rail import judge
from cell.apps.commission.sequence import by_name
from cell.config.cell_config import load_config
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from drivers.errors import DeviceFault, RefusedError
from tests.support.commissioning import SEED, Shown, files, opened


def judged(told: float, moved: tuple[float, float, float]) -> list[str]:
    result = Result()
    judge(load_config(None).rail, result, told, 1e-3 * np.array(moved))
    return [f"{finding.name} {finding.write}" for finding in result.findings]


def test_a_rail_is_judged_by_the_way_that_its_camera_went():
    assert (judged(0.005, (4.97, 0.05, -0.1)), judged(-0.005, (-4.97, 0.05, -0.1))) == ([], [])
    assert judged(0.005, (-5.02, 0.1, 0.0)) == ["rail.reversed {'rail.reversed': 'true'}"]
    assert judged(0.005, (9.95, 0.1, 0.0)) == ["rail.lead {'rail.lead': '\"4 mm\"'}"]
    assert judged(-0.005, (1.26, 0.0, 0.0)) == [
        "rail.reversed {'rail.reversed': 'true'}", "rail.lead {'rail.lead': '\"0.5 mm\"'}",
    ]  # fmt: skip
    # Across its x axis it is no reversed rail, but a camera that is turned on the carriage.
    assert judged(0.005, (0.1, 5.0, 0.0)) == []
    with pytest.raises(RefusedError, match="coupling"):
        judged(0.005, (0.02, 0.01, 0.0))


def test_a_rail_whose_motor_turns_backwards_is_nudged_but_finds_no_zero_until_it_is_turned_round():
    config, described = load_config(None), Described.of("pot")
    backwards = config.model_copy(update={"rail": config.rail.model_copy(update={"reversed": True})})
    cell = VirtualCell(config, SEED, described=described, truth=backwards)
    before = cell.world.rail.carriage(cell.clock.now())
    cell.rail.nudge(0.005, 0.005).wait(10.0)
    assert cell.world.rail.carriage(cell.clock.now()) - before == pytest.approx(-0.005, abs=1e-4)
    with pytest.raises(DeviceFault, match=r"right limit switch tripped .* the motor turns the other way"):
        cell.rail.home().wait(10.0)
    assert cell.world.rail.carriage(cell.clock.now()) < 0.1035  # short of the end stop
    right = VirtualCell(backwards, SEED, described=described)
    right.rail.nudge(0.005, 0.005).wait(10.0)
    assert right.world.rail.carriage(right.clock.now()) - before == pytest.approx(0.005, abs=1e-4)
    right.rail.home().wait(60.0)
    assert right.world.rail.carriage(right.clock.now()) == pytest.approx(0.0, abs=1e-4)


def test_limit_switches_that_are_exchanged_are_found_by_name_short_of_the_end_stop(tmp_path):
    files(tmp_path)
    made, result = opened(tmp_path, Shown()), Result()
    with closing(made.workplace):
        simulated = made.workplace.cell.simulated
        simulated.fault("rail.exchanged_switches")
        by_name("rail_limits").work(made.workplace, result)
        (finding,) = result.findings
        assert "left limit switch at the left end, measured that of the other end" in str(finding)
        assert not simulated.world.rail.stalled(simulated.clock.now())
