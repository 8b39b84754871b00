"""The least time of a motion is that of a straight one at the limits, and what a run's time is made of adds up."""

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.run.report.page.course import Activity, activities
from lab.bench.job.cycle import LeastTimes, told
from lab.bench.job.whole_job import JobRecord
from tests.support.at_station import AtStation


def test_a_motion_takes_at_least_what_speed_acceleration_and_jerk_need(placed_pot: JobRecord, tmp_path):
    site = AtStation(placed_pot, tmp_path)
    config = load_config(None)
    least = LeastTimes.of(site.cell.devices, config, site.job)
    start, end = np.zeros(6), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    turn = Activity("arm", 0.0, 9.0, first={"joints": start.tolist()}, last={"joints": end.tolist()})
    speed, acceleration, jerk = (getattr(config.arm, f"max_joint_{name}") for name in ("speed", "acceleration", "jerk"))
    # Its last joint carries nothing far out: joint limits alone bind. Closed form of a profile of seven phases.
    assert least(turn) == pytest.approx(1.0 / speed + speed / acceleration + acceleration / jerk, rel=0.02)
    drive = Activity("vehicle", 0.0, 9.0, first={"x": 0.0, "y": 0.0}, last={"x": 3.0, "y": 4.0})
    assert least(drive) == pytest.approx(5.0 / site.job.approach.speed)
    assert least(Activity("arm", 1.0, 3.0)) == 2.0


def test_what_a_run_is_made_of_adds_up(placed_pot: JobRecord, tmp_path):
    site = AtStation(placed_pot, tmp_path)
    found = activities(placed_pot.folder)
    length = max(one.end for one in found)
    result = told(found, length, LeastTimes.of(site.cell.devices, load_config(None), site.job))
    motions = result["motions"]
    assert isinstance(motions, list) and len(motions) > 5
    # No motion is quicker than its bound, but for the time between two states.
    assert all(one["lasts_s"] > one["least_s"] - 0.1 for one in motions), motions
    assert result["arm_and_vehicle_s"] == pytest.approx(sum(one["lasts_s"] for one in motions))
    whole = sum(float(str(result[name])) for name in ("arm_and_vehicle_s", "laser_lit_s", "nothing_done_s"))
    assert 0.8 * length < whole < 1.1 * length
