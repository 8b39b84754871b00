"""A part is found in its nest, gripped where it lies, and placed; and what keeps it from being gripped."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cell import Cell, ConfigError
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration.drift.slip import Slip
from cell.measure.geometry.poses import difference, from_matrix
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.place_pose import PlacePose
from cell.motion.collision import PLACED
from cell.procedures.arm.moves import PartState
from cell.procedures.steps import pick_nest, verify_nest
from cell.procedures.steps.kinds import PLACE
from cell.run.record.replay import replay
from drivers.errors import RefusedError
from lab.bench.job.whole_job import JobRecord
from sim_backends.world.drawing import inverse
from statemachine.step import Event
from tests.support import described_cells
from tests.support.at_station import AtStation
from tests.support.described_cells import UNDRAWN, described, quick_job
from tests.support.report_runs import changed

SHIPPED, MESH = load_job("load")
JOB = changed(SHIPPED, "scan", speed=2.0 * SHIPPED.scan.speed, frame_rate=20.0)


def before_pick(record: JobRecord, folder: Path) -> AtStation:
    """A cell where `record` placed, with the part of `load` in its nest."""
    return AtStation(record, folder, JOB, NominalSurface.load(MESH, unit=JOB.surface.mesh_unit))


@pytest.mark.parametrize(
    ("metres", "told"),
    [
        (3e-3, r"the part lies [23]\.\d\d mm off its place in the nest, on average \(allowed: 2 mm\)"),
        (15e-3, r"the part is not seen in its nest: (it lies 1[45]|[45]\d % of the points)"),
        (0.2, "the nest is empty: nothing was seen where the part belongs"),
    ],
)
def test_a_part_that_is_not_in_its_nest_is_not_gripped(placed_pot: JobRecord, tmp_path, metres: float, told: str):
    site = before_pick(placed_pot, tmp_path)
    part = site.cell.world.part
    part._base_from_part[0, 3] += metres  # type: ignore[index]
    with pytest.raises(RefusedError, match=told):
        site.do("pick")
    assert not part.held and part.untouched and site.work.part.state is PartState.NESTED


def test_what_a_head_that_slipped_leaves_open_of_the_held_part_is_known(placed_pot: JobRecord, tmp_path, monkeypatch):
    shares, slips = [], iter([Slip(0.0, 0.0, 0.0), Slip(0.09e-3, 0.0, 0.0)])
    look = pick_nest.seen_on_plate

    def register(*given: object, systematic: np.ndarray, **named: object) -> PlacePose:
        shares.append(np.sqrt(np.diag(systematic))[:3])
        raise RefusedError("seen enough")

    monkeypatch.setattr(pick_nest, "seen_on_plate", lambda *given: (look(*given)[0], next(slips)))
    monkeypatch.setattr(verify_nest, "register", register)
    for _ in range(2):
        with pytest.raises(RefusedError, match="seen enough"):
            before_pick(placed_pot, tmp_path).do("pick")
    still, slipped = shares
    assert np.linalg.norm(slipped) > 0.09e-3 > 1.5 * np.linalg.norm(still)


def test_an_old_part_is_swapped_for_a_new_one_and_the_item_that_was_aborted_is_resumed(
    placed_pot: JobRecord, calibrated_folder: Path
):
    file, (undrawn, _) = quick_job("swap", calibrated_folder, 20.0), described(calibrated_folder, UNDRAWN)
    once = described_cells.changed(file.read_text(encoding="utf-8"), {"place": {"corrections": "0"}})
    file.write_text(once, encoding="utf-8")
    with Cell.open(undrawn, sim="all", seed=placed_pot.seed, clock="virtual", job=file) as cell:
        world, begun = cell.simulated.world, list[str]()
        # It lies as the world has drawn it, which is not where the job expects it.
        nest = load_job(f"{file}#2")[0].nest
        lay = from_matrix(world._items[1].part._base_from_part)
        off = difference(lay, nest.base_from_part.se3())
        assert 0.1e-3 < np.linalg.norm(off[:3]) < 2e-3

        def end(event: Event) -> None:
            begun.extend([event.step or ""] * (event.kind == "step_started"))
            if begun.count("pick") == 2 and cell.current is not None:
                cell.current.abort("seen enough")

        with pytest.raises(ConfigError, match="set_down"):
            cell.run_batch(file, inject=["arm.protective_stop@set_down:40%"])
        with pytest.raises(ConfigError, match=r"has 2 items: name one, such as .*swap\.toml#1, or run all as a batch"):
            cell.run(file)
        batch = cell.run_batch(file, observer=end)
        assert [run.outcome for run in batch.runs] == ["placed", "aborted"]
        assert [run.report["part"] for run in batch.runs] == ["released", "in its nest"]
        assert begun[: begun.index("pick")] == list(PLACE.names[:5])
        assert begun[-2:] == ["drive_to_target", "pick"]
        standing: list[set[str]] = []

        def stands(event: Event) -> None:
            if (event.kind, event.step) == ("progress", "pick"):
                standing.append({body.name for body in cell.devices.interlocks.situation.station})

        done = cell.resume(observer=stands)
        assert standing and all(names >= {"table", "board", PLACED} for names in standing)
        assert (done.outcome, done.report["part"], done.report["job"]) == ("placed", "released", "swap#2")
        assert all(each.same for each in replay(done.folder)), "perception, from what was kept of an item"
        old, new = (item.part for item in world._items)
        assert not (old.held or new.held) and world.collisions.found == ()
        flange = np.eye(4)
        lies = from_matrix(inverse(world.scene.world_from_surface) @ new.part_pose(flange))
        seen = done.results["verify"]
        error = difference(seen.seen.surface_from_part, lies)
        assert error @ np.linalg.solve(seen.covariance, error) < 22.5, "of 1,000 by chance one"
        # The old one rides in its nest, .5 m from there.
        assert np.linalg.norm((old.part_pose(flange) - new.part_pose(flange))[:2, 3]) > 0.3
        # The claw holds the new one as it lay: known to what its sweep told, not to what the job states.
        picked = done.results["pick"]
        assert np.sqrt(np.diag(picked.covariance)[:3]).max() < 0.08e-3
        assert done.results["place"].touch.expected.sigma < 0.11e-3
        grip = difference(picked.base_from_flange, lay * JOB.grasp.flange_from_part.se3().inverse())
        assert np.linalg.norm(grip[:3]) < 0.3e-3
        # Both are gone: a person makes all ready again.
        again = cell.run(f"{file}#1", until="drive_to_target")
        assert (again.outcome, again.report["part"], world.parts) == ("done", "at the station", 2)


def test_a_part_that_the_claw_took_from_its_nest_is_placed_by_the_run_that_resumes(
    placed_pot: JobRecord, calibrated_folder: Path
):
    load, (undrawn, _) = quick_job("load", calibrated_folder, 20.0), described(calibrated_folder, UNDRAWN)
    unseen = described_cells.changed(load.read_text(encoding="utf-8"), {"place": {"verify": '"none"'}})
    load.write_text(unseen, encoding="utf-8")
    with Cell.open(undrawn, sim="all", seed=placed_pot.seed, clock="virtual", job=load) as cell:

        def until(step: str, text: str) -> Callable[[Event], None]:
            def end(event: Event) -> None:
                if event.step == step and text in str(event.data.get("text")) and cell.current is not None:
                    cell.current.abort("seen enough")

            return end

        # Close above the surface, from where the arm goes straight up at first; and before the step that picks.
        first = cell.run(load, observer=until("place", "feeling"))
        second = cell.resume(observer=until("drive_to_target", "in sight"))
        assert [(run.outcome, run.report["part"]) for run in (first, second)] == [("aborted", "held")] * 2
        done = cell.resume()
        assert (done.outcome, done.report["part"]) == ("placed", "released"), done.reason
        assert np.array_equal(done.results["pick"].covariance, first.results["pick"].covariance)
        assert list(first.folder.glob("frames/nest-*")) and not list(done.folder.glob("frames/nest-*"))
        assert isinstance(cell.simulated, VirtualCell) and cell.simulated.world.collisions.found == ()
