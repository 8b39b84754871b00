"""The interim check on the devices without wires: a job is refused, or told, before its part moves."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig, load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration.drift.evidence import INTERIM_VIEW
from cell.measure.calibration.drift.slip import HeadShift
from cell.measure.inversion import NominalSurface
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.interim import LOOKS, MOVED, InterimCheck, fine_board_view, interim_check, resting_pose
from cell.procedures.steps.drive_to_target import VehicleArrival
from cell.run.report.report import pose_of
from drivers.errors import RefusedError
from lab.bench.calibration.interim import planted
from lab.bench.job.whole_job import JobRecord, run_whole_job
from sim_backends.world.scene import rotation
from tests.support.at_station import AtStation

CONFIG = load_config(None)
JOB, MESH = load_job("pot")
SHIFTS = {each.name: each for each in planted()}


def looked(
    made: JobRecord, put_in: Callable[[VirtualCell], None] = lambda cell: None
) -> tuple[InterimCheck, list[str]]:
    """What the check says of the cell that was calibrated for `placed_pot`, and which frames were kept."""
    cell = VirtualCell(CONFIG, made.seed)
    put_in(cell)
    cell.devices.vehicle.brake()
    cell.devices.interlocks.work_with(made.calibration.configuration)
    kept: list[str] = []
    found = interim_check(
        CONFIG, cell.devices, Mover(cell.devices.arm, cell.clock, CONFIG, JOB), made.calibration, JOB,
        check=lambda: None, progress=lambda text: None, keep=lambda what, frame: kept.append(what),
    )  # fmt: skip
    return found, kept


@pytest.fixture(scope="module")
def untouched(placed_pot: JobRecord) -> tuple[InterimCheck, list[str]]:
    return looked(placed_pot)


def test_a_cell_that_nobody_touched_passes_and_says_what_it_saw(
    placed_pot: JobRecord, untouched: tuple[InterimCheck, list[str]]
):
    found, kept = untouched
    assert not found.head.changed and found.notes == ()
    found.require()
    assert kept == [f"interim-{k + 1}" for k in range(found.head.looks)]
    told = found.summary()
    assert told["changed"] is False and told["looks"] == len(kept)
    assert 0.0 < found.effect < found.at_most < 0.3e-3
    arrival = placed_pot.results["drive_to_target"]
    assert isinstance(arrival, VehicleArrival) and arrival.head is not None
    assert arrival.summary()["interim"] == arrival.head.summary()
    # It rests above where the next job looks first.
    rest = resting_pose(fine_board_view(CONFIG, placed_pot.calibration))
    assert np.linalg.norm(rest.actInv(pose_of(placed_pot.at_end, "base_from_flange")).translation) < 1e-3


def test_each_job_looks_from_where_the_calibration_looked(placed_pot: JobRecord):
    calibration = placed_pot.calibration
    scan = calibration.scan
    then, view = scan.reference.pictures[INTERIM_VIEW], fine_board_view(CONFIG, calibration)
    assert (view.base_from_flange, view.rail_position) == (then.base_from_flange, then.rail)
    again = type(scan).from_dict(scan.as_dict()).reference
    assert again.pictures[INTERIM_VIEW].as_dict() == then.as_dict() and again.repeats == scan.reference.repeats
    older = replace(calibration, scan=replace(scan, reference=replace(scan.reference, pictures={})))
    aimed = fine_board_view(CONFIG, older).base_from_flange
    assert 1e-5 < np.linalg.norm(aimed.actInv(then.base_from_flange).translation) < 0.02


def test_what_moves_the_place_too_far_refuses_with_the_number_and_the_next_step(placed_pot: JobRecord):
    found, kept = looked(placed_pot, SHIFTS["last joint's zero, 4 mrad"].put_in)
    assert found.head.changed and found.matters and len(kept) == found.head.looks == 1
    with pytest.raises(RefusedError, match=r"has moved: by .* allowed are 0\.18 mm.*then run `cell calibrate`") as met:
        found.require()
    (number,) = met.value.numbers
    assert (number.name, number.kept) == (MOVED, False)
    assert number.value == pytest.approx(1e3 * found.at_most)
    assert f"{1e3 * found.effect:.2f} mm off, at most {1e3 * found.at_most:.2f} mm" in str(met.value)


def test_a_lens_that_moved_looks_like_a_head_that_moved(placed_pot: JobRecord):
    found, _ = looked(placed_pot, SHIFTS["scan camera's middle, 1.5 px"].put_in)
    assert found.head.changed


def test_what_may_be_chance_is_looked_at_again_and_all_looks_count(
    placed_pot: JobRecord, untouched: tuple[InterimCheck, list[str]]
):
    found = [looked(placed_pot, SHIFTS[f"scan head, .1 mm along {axis}"].put_in)[0].head for axis in "xyz"]
    assert all(head.changed or not head.suspicious or head.looks == LOOKS for head in found)
    seen = [*found, untouched[0].head, looked(placed_pot, SHIFTS["fine board, .2 mm"].put_in)[0].head]
    once, more = ([np.diag(head.covariance)[:3] for head in seen if (head.looks == 1) == one] for one in (True, False))
    assert once and more and all((many < 0.8 * once[0]).all() for many in more)


def test_a_job_whose_head_has_moved_ends_before_the_vehicle_drives(placed_pot: JobRecord):
    nominal = NominalSurface.load(MESH, unit=JOB.surface.mesh_unit)
    moved = SHIFTS["last joint's zero, 4 mrad"].put_in
    ended = run_whole_job(CONFIG, JOB, nominal, placed_pot.seed, "nominal", calibrated=placed_pot, changed=moved)
    assert (ended.outcome, ended.stage) == ("refused", "drive_to_target")
    assert "the scan head on the flange, a joint's zero, or the fine board" in ended.reason
    here, there = (pose_of(end, "world_from_vehicle").translation for end in (ended.at_end, placed_pot.at_end))
    assert np.linalg.norm(here - there) > 1.0


def arrived(
    record: JobRecord, folder: Path, calibration: CellCalibration, config: CellConfig = CONFIG
) -> tuple[VehicleArrival, list[str]]:
    """How a cell that stands at its target arrives there, and what is noted of it."""
    notes: list[str] = []
    site = AtStation(record, folder, notify=lambda event: notes.append(str(event.data.get("text"))))
    site.work.config, site.work.calibration = config, calibration
    return site.do("drive_to_target"), notes


def test_a_cell_that_does_not_want_it_is_not_looked_at(placed_pot: JobRecord, tmp_path):
    unlooked = CONFIG.calibration.model_copy(update={"each_job": False})
    config = CONFIG.model_copy(update={"calibration": unlooked})
    arrival, _ = arrived(placed_pot, tmp_path, placed_pot.calibration, config)
    assert arrival.head is None and "interim" not in arrival.summary()


def test_a_calibration_of_an_older_program_is_not_looked_at_and_the_job_says_so(placed_pot: JobRecord, tmp_path):
    made = placed_pot.calibration
    old = replace(made, scan=replace(made.scan, reference=None))
    arrival, notes = arrived(placed_pot, tmp_path, old)
    assert arrival.head is None
    assert any(
        "has moved since the calibration is not seen: the stored calibration holds no ref" in text for text in notes
    )


def test_a_board_that_is_covered_is_refused_with_what_to_do(placed_pot: JobRecord):
    def away(cell: VirtualCell) -> None:
        moved = cell.world.scene.base_from_fine_board.copy()
        moved[:3, 3] += 0.2
        cell.world.remake(replace(cell.world.scene, base_from_fine_board=moved), cell.world.station)

    with pytest.raises(RefusedError, match="the fine board on the deck is not seen where the calibration has it"):
        looked(placed_pot, away)


def seen(**changes: object) -> InterimCheck:
    head = HeadShift(np.array([1e-4, 0, 0, 0, 0, 1e-3]), 1e-10 * np.eye(6), dots=1.0, chance=1e-9, looks=2)
    made = InterimCheck(head, 0.1e-3, 0.15e-3, tolerance=0.6e-3, off=np.array([1e-4, 0, 0]), sigma=np.full(3, 1e-5))
    return replace(made, **changes)  # type: ignore[arg-type]


def test_a_change_that_does_little_is_told_and_the_job_goes_on():
    found = seen()
    found.require()
    (note,) = found.notes
    assert "by (+0.10, +0.00, +0.00) mm and (+0.00, +0.00, +1.00) mrad in the flange's axes" in note
    assert "0.10 mm off, at most 0.15 mm: the job goes on. Run `cell calibrate` when there is time" in note
    assert seen(head=replace(found.head, chance=0.5)).notes == ()


def test_what_may_do_too_much_counts_and_only_if_it_is_no_chance():
    assert seen(at_most=0.181e-3).matters and not seen(at_most=0.179e-3).matters
    assert not seen(at_most=0.5e-3, head=replace(seen().head, chance=0.01)).matters


def test_a_look_that_leaves_too_much_open_says_so():
    (note,) = seen(at_most=0.25e-3, head=replace(seen().head, chance=0.5)).notes
    assert "what it leaves open may put the place 0.25 mm off (allowed 0.18 mm). `cell calibrate verify`" in note


def test_pictures_that_fit_badly_are_refused():
    with pytest.raises(
        RefusedError, match=r"fits its picture 1\.7 times worse .* allowed 1\.6 times.*calibrate verify"
    ):
        seen(head=replace(seen().head, dots=1.7, chance=0.9)).require()


def test_its_figures_are_those_of_the_head():
    assert seen().summary() == {
        "shift_mm": [0.1, 0.0, 0.0], "turn_mrad": [0.0, 0.0, 1.0], "sigma_mm": [0.01] * 3, "sigma_mrad": [0.01] * 3,
        "place_mm": 0.1, "place_at_most_mm": 0.15, "place_allowed_mm": 0.18, "off_mm": [0.1, 0.0, 0.0],
        "off_sigma_mm": [0.01] * 3, "dots": 1.0, "chance": 1e-9, "looks": 2, "changed": True,
    }  # fmt: skip


@pytest.mark.parametrize(("axis", "lever"), [(0, JOB.scan.stand_off), (2, 0.05)])
def test_a_turn_moves_the_place_by_its_distance(placed_pot: JobRecord, axis: int, lever: float):
    """Of 10 mrad about the camera's x, 130 mm; about its axis, the 50 mm that the rail stands out in mid-sweep."""
    turn = 10e-3 * np.eye(3)[axis]

    def put_in(cell: VirtualCell) -> None:
        head = cell.world.scene.flange_from_scan_camera.copy()
        head[:3, :3] = head[:3, :3] @ rotation(turn)
        cell.world.remake(replace(cell.world.scene, flange_from_scan_camera=head), cell.world.station)

    found, _ = looked(placed_pot, put_in)
    assert np.linalg.norm(found.head.change[3:]) == pytest.approx(10e-3, abs=0.5e-3)
    assert np.linalg.norm(found.off) == pytest.approx(10e-3 * lever, abs=0.2e-3)
    assert found.effect == pytest.approx(10e-3 * lever, rel=0.5)


@pytest.mark.campaign
def test_every_planted_shift_is_found_in_a_cell(placed_pot: JobRecord):
    missed = [name for name, each in SHIFTS.items() if not looked(placed_pot, each.put_in)[0].head.changed]
    assert len(missed) <= 2
