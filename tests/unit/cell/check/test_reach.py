"""What the arm has to reach for a job, and what is told of what it does not."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from cell.check.reach import _sweeps, _unreached, nominal_scan
from cell.config.cell_config import CellConfig, load_config
from cell.motion.kinematics import Unreachable
from cell.procedures.arm.photograph import scan_plans
from cell.procedures.sweep.sweeping import RUN_UP_S
from tests.unit.cell.check.test_place import changed


@pytest.fixture(scope="module")
def config() -> CellConfig:
    return load_config(None)


def test_sweeps_are_planned_with_the_scan_head_as_drawn(config: CellConfig) -> None:
    head = nominal_scan(config)
    np.testing.assert_array_equal(head.rail_direction, [1.0, 0.0, 0.0])
    assert not head.covariance.any()


@pytest.mark.parametrize(("mode", "run_up"), [("rail", 0.0), ("arm", RUN_UP_S * 0.015)])
def test_a_sweep_by_the_arm_reaches_from_its_run_up_to_its_run_out(
    mode: str, run_up: float, config: CellConfig
) -> None:
    job = changed("scan.mode", mode)
    surface = pin.SE3(np.eye(3), np.array([0.7, 0.3, 0.1]))
    (plan,) = scan_plans(config, job, surface, nominal_scan(config))
    (_, begin, _), (_, end, _) = _sweeps(job, config, surface)
    ahead = [surface.actInv(pose).translation[0] for pose in (begin, plan.base_from_flange, plan.base_from_flange_end)]
    ahead.append(surface.actInv(end).translation[0])
    assert np.diff(ahead) == pytest.approx([run_up, job.scan.length * (mode == "arm"), run_up], abs=1e-9)


def test_of_many_poses_out_of_reach_three_are_told() -> None:
    class Short:
        def reach(self, goal: pin.SE3, joints: object, what: str, allowed: object) -> object:
            if what == "near":
                return joints
            raise Unreachable("out of reach")

    goals = [(what, pin.SE3.Identity(), ()) for what in ("near", "a", "b", "near", "c", "d")]
    told = list(_unreached(Short(), iter(goals)))  # type: ignore[arg-type]
    assert told == [f"{what}: out of reach" for what in "abc"]
