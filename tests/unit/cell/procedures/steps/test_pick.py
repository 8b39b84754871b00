"""A part is found by its own mesh, gripped where it lies, set into its nest and looked at there: whole virtual jobs."""

import json
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cell import Cell
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import difference, from_matrix, from_parts
from cell.procedures.arm.moves import PartState
from cell.procedures.grasp import GRIPPED, job_with_grasp
from cell.run.record.replay import replay
from cell.run.report.page.make import make_page
from drivers.errors import ConfigError, DeviceFault, RefusedError
from lab.bench.job.whole_job import JobRecord
from sim_backends.models.arm import Safety
from statemachine.step import Event
from tests.support.at_station import lose_few_steps_after_the_look
from tests.support.described_cells import LEAN, described, quick_job
from tests.support.unloading import JOB, Change, unloaded, where_unloaded


def test_a_part_that_sticks_is_let_go_where_it_lies(unloaded_part: JobRecord, tmp_path):
    site = where_unloaded(unloaded_part, tmp_path)
    lay, part = from_matrix(site.cell.truth()["poses"]["surface_from_part"]), site.cell.world.part
    part.sticks = 60.0
    with pytest.raises(RefusedError, match=r"the part sticks, or is heavier .* pulled with more than 24 N and let go"):
        site.do("pick")
    assert not part.held and site.work.part.state is PartState.LIES
    moved = difference(from_matrix(site.cell.truth()["poses"]["surface_from_part"]), lay)
    assert np.linalg.norm(moved[:3]) < 0.1e-3
    assert site.cell.world.arm.safety is Safety.NORMAL


def test_a_grasp_that_was_seen_is_known_to_that_and_to_what_closing_moves():
    held = from_parts((0.001, -0.002, 0.17), pin.exp3(np.array([0.01, -0.02, 0.5])))
    seen = np.diag([30e-6**2, 40e-6**2, 20e-6**2, 0.3e-3**2, 0.1e-3**2, 0.2e-3**2])
    grasp = job_with_grasp(JOB, held, seen).grasp
    assert np.allclose(grasp.flange_from_part.se3().homogeneous, held.homogeneous, atol=1e-12)
    assert grasp.sigma == float(np.sqrt(40e-6**2 + GRIPPED[1, 1]))
    assert grasp.sigma_angle == float(np.sqrt(0.3e-3**2 + GRIPPED[3, 3])) and grasp.size == JOB.grasp.size


def test_a_part_is_taken_from_its_surface_into_its_nest(unloaded_part: JobRecord):
    done = unloaded_part
    assert done.at_sweep and done.at_end and done.folder and JOB.nest
    lay, lies = (from_matrix(truth["poses"]["base_from_part"]) for truth in (done.at_sweep, done.at_end))
    # Where the world has put it is drawn: some tenths of a millimetre from where the job expects it.
    found = difference(done.results["invert_pose"].base_from_surface, lay)
    assert np.linalg.norm(found[:3]) < 0.3e-3 and np.linalg.norm(found[3:]) < 1.5e-3
    nest = difference(lies, JOB.nest.base_from_part.se3())
    assert np.linalg.norm(nest[:3]) < 0.5e-3 and np.linalg.norm(nest[3:]) < 3e-3
    seen = done.results["verify"]
    error = difference(seen.seen.surface_from_part, lies)
    assert error @ np.linalg.solve(seen.covariance, error) < 22.5, "of 1,000 by chance one"
    assert not done.at_end["part"]["held"] and done.at_end["collisions"] == []
    report = json.loads((done.folder / "report.json").read_text(encoding="utf-8"))
    assert re.fullmatch(r"in place: 0\.\d\d ± 0\.\d\d mm off", report["reason"]) and report["part"] == "released"
    told = (report["nest_error"]["translation_mm"], report["pose_error"]["translation_mm"])
    assert np.allclose(told, [1e3 * error[:3], 1e3 * found[:3]], atol=1e-3)
    assert report["tolerance"]["translation_mm"] == 1e3 * JOB.nest.tolerance
    assert "placed part off its place" in make_page(done.folder)
    assert all(each.same for each in replay(done.folder))


def test_steps_that_the_rail_lost_are_found_before_the_grip(unloaded_part: JobRecord, tmp_path, monkeypatch):
    site = where_unloaded(unloaded_part, tmp_path)
    lose_few_steps_after_the_look(monkeypatch, lambda: site.cell)
    with pytest.raises(DeviceFault, match="lost steps"):
        site.do("pick")
    assert not site.cell.world.part.held


def test_a_part_that_is_lost_as_it_is_lifted_is_known_to_nobody_and_that_is_noted(
    unloaded_part: JobRecord, tmp_path, monkeypatch
):
    site, parts = where_unloaded(unloaded_part, tmp_path), list[object]()
    site.notify = lambda event: parts.append(event.data.get("part"))
    monkeypatch.setattr(type(site.cell.devices.claw), "holding", property(lambda claw: False))
    with pytest.raises(RefusedError, match="the claw lost the part as it lifted it"):
        site.do("pick")
    assert [part for part in parts if part] == ["unknown", "held", "unknown"]
    assert site.work.part.state is PartState.UNKNOWN


def take_away(cell: VirtualCell) -> None:
    part = cell.world.part
    part._world_from_part[0, 3] += 0.2


def hold(cell: VirtualCell) -> None:
    cell.world.part._world_from_part = None
    cell.world._close_claw(True)
    cell.world._report_grip()


@pytest.mark.parametrize(
    ("change", "stage", "told"),
    [
        (take_away, "invert_pose", "the part to be unloaded is not seen where it belongs: 0 of "),
        (hold, "drive_to_target", "the claw holds a part, and job unload takes one that is at the station"),
    ],
)
def test_where_there_is_no_part_or_the_claw_is_full_nothing_is_gripped(
    placed_pot: JobRecord, change: Change, stage: str, told: str
):
    done = unloaded(placed_pot, change)
    assert (done.outcome, done.stage) == ("refused", stage) and told in done.reason
    assert "pick" not in done.results


def test_through_the_public_door_it_is_not_resumed_once_it_was_gripped_and_the_next_part_lies_there(
    placed_pot: JobRecord, calibrated_folder: Path
):
    unload, (lean, _) = quick_job("unload", calibrated_folder, 20.0), described(calibrated_folder, LEAN)
    with Cell.open(lean, sim="all", seed=placed_pot.seed, clock="virtual", job=unload) as cell:

        def end(event: Event) -> None:
            if event.kind == "step_started" and event.step == "set_down" and cell.current is not None:
                cell.current.abort("seen enough")

        ended = cell.run(unload, end)
        assert (ended.outcome, ended.report["part"]) == ("aborted", "held")
        with pytest.raises(ConfigError, match="had gripped a part that lay"):
            cell.resume(ended.folder)
        again = cell.run(unload, until="drive_to_target")
        assert (again.outcome, again.report["part"]) == ("done", "at the station"), "the claw is empty again"
