"""What the arm has to reach for a job, and what is told of what it does not."""

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from cell.check.fit import require_fit
from cell.check.reach import _sweeps, _unreached, nominal_scan, seen_faces, verify_problems
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.measure.inversion.nominal import read_mesh
from cell.motion.kinematics import Unreachable
from cell.procedures.arm.photograph import scan_plans
from cell.procedures.sweep.sweeping import RUN_UP_S
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import body, job_with_part
from tests.unit.cell.check.test_place import changed

CONFIG = load_config(None)


def test_sweeps_are_planned_with_the_scan_head_as_drawn():
    head = nominal_scan(CONFIG)
    np.testing.assert_array_equal(head.rail_direction, [1.0, 0.0, 0.0])
    assert not head.covariance.any()


@pytest.mark.parametrize(("mode", "run_up"), [("rail", 0.0), ("arm", RUN_UP_S * 0.015)])
def test_a_sweep_by_the_arm_reaches_from_its_run_up_to_its_run_out(mode: str, run_up: float):
    job = changed("scan.mode", mode)
    surface = pin.SE3(np.eye(3), np.array([0.7, 0.3, 0.1]))
    (plan,) = scan_plans(CONFIG, job, surface, nominal_scan(CONFIG))
    (_, begin, _), (_, end, _) = _sweeps(job, CONFIG, surface)
    ahead = [surface.actInv(pose).translation[0] for pose in (begin, plan.base_from_flange, plan.base_from_flange_end)]
    ahead.append(surface.actInv(end).translation[0])
    assert np.diff(ahead) == pytest.approx([run_up, job.scan.length * (mode == "arm"), run_up], abs=1e-9)


def test_of_many_poses_out_of_reach_three_are_told():
    class Short:
        def reach(self, goal: pin.SE3, joints: object, what: str, allowed: object) -> object:
            if what == "near":
                return joints
            raise Unreachable("out of reach")

    goals = [(what, pin.SE3.Identity(), ()) for what in ("near", "a", "b", "near", "c", "d")]
    told = list(_unreached(Short(), iter(goals)))  # type: ignore[arg-type]
    assert told == [f"{what}: out of reach" for what in "abc"]


def test_motions_that_would_not_be_seen_are_told_unless_the_job_says_so(tmp_path):
    job, mesh = load_job(job_with_part(tmp_path, "pot", verify="all"))
    require_fit(job, CONFIG, mesh)
    flat, mesh = load_job(job_with_part(tmp_path, "pot", verify="all", flat=True))
    told = r'pot-part\.ply": the faces of the placed part do not show .*x axis.*place\.verify = "seen"'
    with pytest.raises(ConfigError, match=told):
        require_fit(flat, CONFIG, mesh)
    for verify in ("seen", "none"):
        agreed = flat.model_copy(update={"place": flat.place.model_copy(update={"verify": verify})})
        assert list(verify_problems(agreed, CONFIG)) == []


def test_a_part_too_high_for_the_picture_and_one_that_faces_down_are_told(tmp_path):
    job, _ = load_job(job_with_part(tmp_path, "pot", verify="all"))
    low = job.model_copy(update={"scan": job.scan.model_copy(update={"stand_off": 0.06})})
    assert any("leaves the scan camera's picture" in told for told in verify_problems(low, CONFIG))
    sheet = tmp_path / "sheet.ply"
    trimesh.Trimesh(np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]]), [[0, 2, 1]]).export(sheet)
    down = job.model_copy(update={"part": job.part.model_copy(update={"mesh": str(sheet)})})
    assert [told for told in verify_problems(down, CONFIG) if "no face of part.mesh faces up" in told]


def test_nobody_looks_where_the_job_says_so_or_has_no_mesh(tmp_path):
    job, _ = load_job(job_with_part(tmp_path, "pot", verify="none"))
    assert seen_faces(job) is None and list(verify_problems(job, CONFIG)) == []
    assert seen_faces(load_job("pot")[0]) is None


def test_the_sweep_over_the_placed_part_has_to_be_in_reach(tmp_path):
    """A part of .9 m on a surface that is well in reach."""
    file = job_with_part(tmp_path, "pot", verify="all")
    vertices, faces = read_mesh(tmp_path / "pot.ply", "m")
    high = body(vertices, faces, lambda corners: corners)
    high.vertices[len(vertices) :, 2] += 0.9
    high.export(tmp_path / "pot-part.ply")
    job, mesh = load_job(file)
    with pytest.raises(ConfigError, match=r"sweep 1 \(the placed part\)"):
        require_fit(job, CONFIG, mesh)
