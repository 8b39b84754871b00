"""A stored sweep is trusted only as long as nothing that it stands on has changed."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pinocchio as pin
import pytest

from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration.drift.reference_plate import Pointing
from cell.measure.calibration.drift.slip import Slip
from cell.measure.geometry.poses import from_parts
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.drive.way import Whereabouts
from cell.procedures.frame_store import FrameStore
from cell.procedures.steps.laser_sweep import STEP, SweepRecord
from cell.procedures.steps.workplace import Workplace
from cell.procedures.sweep import stored_sweep
from cell.procedures.sweep.stored_sweep import FILE, FORMAT, StoredSweep, save_sweep
from cell.procedures.sweep.swath import Swath
from drivers.errors import CalibrationStale, InterlockError, RefusedError
from drivers.interfaces import Frame
from lab.bench.job.whole_job import NoFrames
from statemachine.step import Event, StepContext
from tests.unit.cell.config.calibrations.test_store import made
from tests.unit.cell.procedures.sweep.test_sweeping import CONFIG, sweep

CALIBRATION = made()
SIGMA_M, SIGMA_RAD = 1e-4, 2e-4
SEEN = np.diag([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 3)
BOARD = from_parts(np.array([0.9, 0.1, 0.3]))


def fix(base_from_board: pin.SE3) -> BoardFix:
    return BoardFix(base_from_board, SEEN, 0.1, 0.3, ())


@pytest.fixture(scope="module")
def taken() -> Swath:
    return sweep()


@pytest.fixture(scope="module")
def stored(taken: Swath) -> StoredSweep:
    return StoredSweep(Path("run"), SweepRecord((taken,)), BOARD, SEEN)


@pytest.mark.parametrize("away", [0.0, 2.0])
def test_a_sweep_holds_while_the_board_is_seen_where_it_was(stored: StoredSweep, away: float):
    """`away` in standard deviations of the difference of two photographs."""
    confirmed = stored.confirmed_by(fix(BOARD * from_parts((away * np.sqrt(2) * SIGMA_M, 0.0, 0.0))))
    (before,), (after,) = stored.sweep.swaths, confirmed.swaths
    # What two photographs leave open is not known better than that.
    assert np.trace((after.covariance - before.covariance)[:3, :3]) > 2 * 3 * SIGMA_M**2 * 0.999


@pytest.mark.parametrize("way", [(7.0, 0, 0, 0, 0, 0), (0, 0, -7.0, 0, 0, 0), (0, 0, 0, 0, 7.0, 0)])
def test_a_sweep_says_nothing_once_the_board_has_moved(stored: StoredSweep, way: tuple[float, ...]):
    step = np.sqrt(2) * np.array(way) * np.array([SIGMA_M] * 3 + [SIGMA_RAD] * 3)
    moved = pin.SE3(pin.exp3(step[3:]), step[:3])
    with pytest.raises(CalibrationStale, match="the board has moved by"):
        stored.confirmed_by(fix(BOARD * moved))


def test_what_may_have_moved_unnoticed_reaches_the_flange_by_its_lever(stored: StoredSweep):
    """A turn of the station about the board's origin shifts a point elsewhere by turn × way: also with what sign."""
    (before,), (after,) = stored.sweep.swaths, stored.confirmed_by(fix(BOARD)).swaths
    way = before.base_from_flange.translation - BOARD.translation
    moves = np.eye(6)
    for axis in range(3):
        moves[:3, 3 + axis] = np.cross(np.eye(3)[axis], way)
    expected = moves @ (2.0 * SEEN) @ moves.T
    assert after.covariance - before.covariance == pytest.approx(expected, rel=1e-9, abs=1e-18)


def test_a_sweep_is_kept_with_what_was_seen_on_the_plate_before_it(stored: StoredSweep, tmp_path):
    pointing, slip = Pointing(1e-4, 2e-5, 3e-5, 4e-5, 5e-5), Slip(1e-5, -2e-5, 3e-3, True, 0.08)
    save_sweep(tmp_path, replace(stored.sweep, pointing=pointing, slip=slip, doubts=("lost steps?",)), fix(BOARD))
    with np.load(tmp_path / FILE) as kept:
        data = dict(kept)
    assert data["pointing"].tolist() == [1e-4, 2e-5, 3e-5, 4e-5, 5e-5]
    assert data["doubts"].tolist() == ["lost steps?"]
    assert data["slip"].tolist() == [1e-5, -2e-5, 3e-3, 0.08, 1.0]
    assert data["base_from_board"].tolist() == BOARD.homogeneous.tolist()
    assert data["board_covariance"].tolist() == SEEN.tolist()
    np.savez(tmp_path / FILE, **{**data, "format": np.array(3)})
    with pytest.raises(RefusedError, match="format 3, this program reads"):
        StoredSweep.load(tmp_path, CALIBRATION.scan, load_job("pot")[0].scan, CONFIG.laser.exit_point)


def begun(stored: StoredSweep, folder: Path, seen: pin.SE3, attempt: int) -> list[str]:
    """What the step of the sweep tells before anything moves, in a cell that is stopped."""
    cell = VirtualCell(CONFIG, seed=4, level="ideal")
    cell.devices.gate.shut()
    (folder / FILE).write_bytes(b"of the attempt before")
    nothing_known = cast(Any, None)
    job = load_job("pot")[0]
    whereabouts = Whereabouts(cell.devices.vehicle)
    workplace = Workplace(
        CONFIG, job, nothing_known, nothing_known, cell.devices, NoFrames(), folder, whereabouts, earlier=stored
    )
    events: list[Event] = []
    context = StepContext(STEP.policy, attempt, 1e9, {"board_photo": fix(seen)}, cell.clock, events.append)
    with pytest.raises((InterlockError, AttributeError)):
        STEP.work(workplace, context)
    assert attempt > 1 or workplace.earlier is None, "what is to be swept again was not good enough"
    assert not (folder / FILE).exists(), "should this run be cut short now, it is not resumed with that"
    return [str(event.data.get("text")) for event in events]


def test_an_earlier_sweep_is_not_taken_where_the_board_has_moved_but_swept_anew(stored: StoredSweep, tmp_path):
    said = begun(stored, tmp_path, BOARD * from_parts((0.01, 0.0, 0.0)), 1)
    assert "the board has moved by 10.00 mm" in said[-1] and "sweeping again" in said[-1]


def test_a_sweep_that_a_fault_ended_is_repeated_only_after_another_look_at_the_board(stored: StoredSweep, tmp_path):
    assert begun(stored, tmp_path, BOARD, 2)[0] == "looking whether the board still stands where it did"


def test_a_sweep_is_not_read_once_a_figure_was_edited_or_two_of_its_frames_are_exchanged(
    taken: Swath, tmp_path, monkeypatch
):
    with FrameStore(tmp_path / "frames") as frames:
        for frame_id in taken.seen.tolist():
            frames.keep("stripe", Frame(np.full((9, 9), frame_id % 200, np.uint8), frame_id, 0.0, 0.0, 0.0, 0.0))
        save_sweep(tmp_path, SweepRecord((taken,)), fix(BOARD), frames.settle())
    # These pictures show no stripe.
    monkeypatch.setattr(stored_sweep, "_swath", lambda *given: taken)
    given = CALIBRATION.scan, load_job("pot")[0].scan, CONFIG.laser.exit_point
    StoredSweep.load(tmp_path, *given).copy_to(tmp_path / "later")
    assert len(StoredSweep.load(tmp_path / "later", *given).sweep.swaths) == 1
    one, other = sorted((tmp_path / "frames").iterdir())[3:5]
    pictures = one.read_bytes(), other.read_bytes()
    one.write_bytes(pictures[1])
    other.write_bytes(pictures[0])
    with pytest.raises(RefusedError, match=f"2 of its frames are not .*: {one.name}, {other.name}"):
        StoredSweep.load(tmp_path, *given)
    with np.load(tmp_path / FILE) as file:
        data = dict(file)
    np.savez(tmp_path / FILE, **{**data, "rail_0": data["rail_0"] + 1e-6})
    with pytest.raises(RefusedError, match="was changed after it was written: rail_0"):
        StoredSweep.load(tmp_path, *given)
    # A replay reads it as it is.
    assert len(StoredSweep.load(tmp_path, *given, as_written=False).sweep.swaths) == 1
    np.savez(tmp_path / FILE, **{**data, "format": np.array(FORMAT - 1)})
    with pytest.raises(RefusedError, match=f"format {FORMAT - 1}, this program reads"):
        StoredSweep.load(tmp_path, *given, as_written=False)


@pytest.mark.parametrize("name", ["rail", "times", "flanges", "line_spread", "covariance"])
def test_a_sweep_with_a_figure_that_is_no_number_is_refused_whoever_wrote_it(taken: Swath, tmp_path, name: str):
    values = getattr(taken, name).copy()
    values.flat[1] = np.nan
    save_sweep(tmp_path, SweepRecord((replace(taken, **{name: values}),)), fix(BOARD))
    with pytest.raises(RefusedError, match=f"{name} of .* holds what is no number"):
        StoredSweep.load(tmp_path, CALIBRATION.scan, load_job("pot")[0].scan, CONFIG.laser.exit_point, as_written=False)


@pytest.mark.parametrize("wrong", [np.zeros((6, 6)), -np.eye(6)], ids=["zero", "negative"])
def test_a_sweep_whose_board_has_no_covariance_is_refused(taken: Swath, tmp_path, monkeypatch, wrong: np.ndarray):
    save_sweep(tmp_path, SweepRecord((taken,)), replace(fix(BOARD), covariance=wrong))
    monkeypatch.setattr(stored_sweep, "_swath", lambda *given: taken)
    with pytest.raises(RefusedError, match="board_covariance"):
        StoredSweep.load(tmp_path, CALIBRATION.scan, load_job("pot")[0].scan, CONFIG.laser.exit_point, as_written=False)
