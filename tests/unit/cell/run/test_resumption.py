"""A run is resumed with its own job, and its sweep is trusted only as long as nothing that it stands on has changed."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from importlib.resources import files
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
from cell.procedures.sweep.stored_sweep import FILE, UNSEALED, StoredSweep, save_sweep
from cell.run.folder import is_going, run_row
from cell.run.resumption import UnfinishedRun, job_hash
from drivers.errors import CalibrationStale, ConfigError, InterlockError, RefusedError
from drivers.interfaces import Frame
from lab.bench.job.whole_job import NoFrames
from statemachine.journal import FILE_NAME, Journal
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
def stored() -> StoredSweep:
    return StoredSweep(Path("run"), SweepRecord((sweep(),)), BOARD, SEEN)


@pytest.mark.parametrize("away", [0.0, 2.0])
def test_a_sweep_holds_while_the_board_is_seen_where_it_was(stored: StoredSweep, away: float) -> None:
    """`away` in standard deviations of the difference of two photographs."""
    confirmed = stored.confirmed_by(fix(BOARD * from_parts((away * np.sqrt(2) * SIGMA_M, 0.0, 0.0))))
    (before,), (after,) = stored.sweep.swaths, confirmed.swaths
    # What two photographs leave open is not known better than that.
    assert np.trace((after.covariance - before.covariance)[:3, :3]) > 2 * 3 * SIGMA_M**2 * 0.999


@pytest.mark.parametrize("way", [(7.0, 0, 0, 0, 0, 0), (0, 0, -7.0, 0, 0, 0), (0, 0, 0, 0, 7.0, 0)])
def test_a_sweep_says_nothing_once_the_board_has_moved(stored: StoredSweep, way: tuple[float, ...]) -> None:
    step = np.sqrt(2) * np.array(way) * np.array([SIGMA_M] * 3 + [SIGMA_RAD] * 3)
    moved = pin.SE3(pin.exp3(step[3:]), step[:3])
    with pytest.raises(CalibrationStale, match="the board has moved by"):
        stored.confirmed_by(fix(BOARD * moved))


def test_what_may_have_moved_unnoticed_reaches_the_flange_by_its_lever(stored: StoredSweep) -> None:
    """A turn of the station about the board's origin shifts a point elsewhere by turn × way: also with what sign."""
    (before,), (after,) = stored.sweep.swaths, stored.confirmed_by(fix(BOARD)).swaths
    way = before.base_from_flange.translation - BOARD.translation
    moves = np.eye(6)
    for axis in range(3):
        moves[:3, 3 + axis] = np.cross(np.eye(3)[axis], way)
    expected = moves @ (2.0 * SEEN) @ moves.T
    assert after.covariance - before.covariance == pytest.approx(expected, rel=1e-9, abs=1e-18)


def test_a_sweep_is_kept_with_what_was_seen_on_the_plate_before_it(stored: StoredSweep, tmp_path: Path) -> None:
    pointing, slip = Pointing(1e-4, 2e-5, 3e-5, 4e-5, 5e-5), Slip(1e-5, -2e-5, 3e-3, True, 0.08)
    save_sweep(tmp_path, replace(stored.sweep, pointing=pointing, slip=slip), fix(BOARD))
    with np.load(tmp_path / FILE) as kept:
        data = dict(kept)
    assert data["pointing"].tolist() == [1e-4, 2e-5, 3e-5, 4e-5, 5e-5]
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
    here = Workplace(
        CONFIG, job, nothing_known, nothing_known, cell.devices, NoFrames(), folder, whereabouts, earlier=stored
    )
    events: list[Event] = []
    context = StepContext(STEP.policy, attempt, 1e9, {"board_photo": fix(seen)}, cell.clock, events.append)
    with pytest.raises((InterlockError, AttributeError)):
        STEP.work(here, context)
    assert not (folder / FILE).exists(), "should this run be cut short now, it is not resumed with that"
    return [str(event.data.get("text")) for event in events]


def test_an_earlier_sweep_is_not_taken_where_the_board_has_moved_but_swept_anew(
    stored: StoredSweep, tmp_path: Path
) -> None:
    said = begun(stored, tmp_path, BOARD * from_parts((0.01, 0.0, 0.0)), 1)
    assert "the board has moved by 10.00 mm" in said[-1] and "sweeping again" in said[-1]


def test_a_sweep_that_a_fault_ended_is_repeated_only_after_another_look_at_the_board(
    stored: StoredSweep, tmp_path: Path
) -> None:
    assert begun(stored, tmp_path, BOARD, 2)[0] == "looking whether the board still stands where it did"


def cut_short(folder: Path, **other: Any) -> tuple[UnfinishedRun, Path]:
    """A run with its own copy of a job that was killed after its sweep."""
    jobs = Path(str(files("cell") / "jobs"))
    for name in ("pot.toml", "pot.ply"):
        shutil.copyfile(jobs / name, folder / name)
    run = folder / "run"
    run.mkdir()
    job = folder / "pot.toml"
    info = {
        "job_file": str(job), "job_hash": job_hash(job), "simulated": False,
        "configuration_hash": CONFIG.calibration_hash(), "calibration_hash": CALIBRATION.hash(), **other,
    }  # fmt: skip
    journal = Journal(run, "run", info)
    journal.step_ended(journal.step_started("laser_sweep", 1), 1.0, {})
    journal.close()
    (run / FILE).write_bytes(b"")
    return UnfinishedRun.find(run, scripted=True), job


@pytest.mark.parametrize("name", ["pot.toml", "pot.ply"])
def test_a_run_whose_job_was_changed_is_not_resumed(tmp_path: Path, name: str) -> None:
    run, _ = cut_short(tmp_path)
    assert run.job == str(tmp_path / "pot.toml")
    with (tmp_path / name).open("ab") as file:
        file.write(b"\n# changed\n")
    with pytest.raises(ConfigError, match="was changed since run"):
        UnfinishedRun.find(run.folder)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({}, "cannot be read as a sweep"),
        ({"calibration_hash": "another"}, "the calibration was changed"),
        ({"configuration_hash": "another"}, "the configuration was changed"),
        ({"simulated": True}, "simulated world"),
    ],
)
def test_a_sweep_is_not_read_under_another_calibration_or_configuration(
    tmp_path: Path, other: dict[str, Any], said: str
) -> None:
    run, job = cut_short(tmp_path, **other)
    sweep, why = run.sweep(load_job(job)[0], CONFIG, CALIBRATION)
    assert sweep is None
    assert said in why


def test_a_sweep_that_a_script_rejected_is_not_used(tmp_path: Path) -> None:
    run, job = cut_short(tmp_path)
    journal = Journal(run.folder, "later", run.info)
    journal.step_ended(journal.step_started("laser_sweep", 1), 1.0, {})
    journal.event("decided", "invert_pose", {"reason": "too few points", "again": "board_photo", "why": "wiped"})
    journal.close()
    sweep, why = UnfinishedRun.find(run.folder).sweep(load_job(job)[0], CONFIG, CALIBRATION)
    assert sweep is None
    assert "had not finished its sweep" in why


def test_a_sweep_that_failed_when_it_was_done_again_is_not_used(tmp_path: Path) -> None:
    run, job = cut_short(tmp_path)
    journal = Journal(run.folder, "later", run.info)
    journal.step_ended(journal.step_started("laser_sweep", 1), 1.0, {})
    journal.step_ended(journal.step_started("laser_sweep", 2), 1.0, error="the arm was pushed")
    journal.close()
    sweep, why = UnfinishedRun.find(run.folder).sweep(load_job(job)[0], CONFIG, CALIBRATION)
    assert sweep is None
    assert "had not finished its sweep" in why


def test_a_sweep_that_was_begun_again_is_not_used(tmp_path: Path) -> None:
    run, job = cut_short(tmp_path)
    journal = Journal(run.folder, "later", run.info)
    journal.step_ended(journal.step_started("laser_sweep", 1), 1.0, {})
    journal.step_started("laser_sweep", 1)
    journal.close()
    sweep, _ = UnfinishedRun.find(run.folder).sweep(load_job(job)[0], CONFIG, CALIBRATION)
    assert sweep is None


def placing(folder: Path, *parts: str) -> Path:
    """A run that was cut short as it placed, and what its journal says of the part."""
    run, _ = cut_short(folder, seed=4, level="nominal", clock="wall", speed=1.0)
    journal = Journal(run.folder, "later", run.info)
    for name in ("drive_to_target", "board_photo", "laser_sweep", "reconstruct", "invert_pose"):
        journal.event("state", None, {"trigger": "next", "to": name})
        journal.step_ended(journal.step_started(name, 1), 1.5, {"points": 61418, "residual_um": [1.7, 0.2]})
    journal.step_started("place", 1)
    for part in parts:
        journal.event("note", "place", {"part": part, "base_from_part": [0.75, 0.0, 0.05, 0.0, 0.0, 1.5]})
    journal.close()
    return run.folder


@pytest.mark.parametrize("parts", [("unknown",), ("unknown", "released"), ("lost",), ("unknown", "releaseb"), (None,)])
def test_a_part_that_is_not_known_to_be_held_is_looked_at_first(tmp_path: Path, parts: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match=r"[Ll]ook (at the part|what has become)"):
        UnfinishedRun.find(placing(tmp_path, *parts))


def damaged(data: bytes, count: int) -> Iterator[bytes]:
    """Copies of a file with a flipped byte, cut off, with two lines exchanged, or with a hole."""
    rng = np.random.default_rng(11)
    for k in range(count):
        bad, at, other = bytearray(data), *rng.integers(0, len(data) - 512, 2).tolist()
        if k % 8 < 5:
            # Where something stands: most of a page is empty.
            at = int(rng.choice(np.flatnonzero(np.frombuffer(data, np.uint8))))
            bad[at] ^= int(rng.integers(1, 256))
        elif k % 8 == 5:
            bad = bad[:at]
        elif k % 8 == 6:
            at, other = at // 64 * 64, other // 64 * 64
            bad[at : at + 64], bad[other : other + 64] = bad[other : other + 64], bad[at : at + 64]
        else:
            bad[at : at + 512] = bytes(512)
        if bad != data:
            yield bytes(bad)


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("parts", [(), ("unknown", "released")])
def test_a_damaged_journal_is_an_error_in_our_words_and_never_a_part_that_is_held(
    tmp_path: Path, parts: tuple[str, ...], older: bool
) -> None:
    folder = placing(tmp_path, *parts)
    path = folder / FILE_NAME
    base = sqlite3.connect(path, isolation_level=None)
    if older:
        for table in ("runs", "steps", "events"):
            base.execute(f"ALTER TABLE {table} DROP COLUMN crc")
    base.execute("PRAGMA journal_mode=DELETE")
    base.execute("VACUUM")
    base.close()
    data, resumed, job = path.read_bytes(), 0, load_job(tmp_path / "pot.toml")[0]
    for bad in damaged(data, 250):
        path.write_bytes(bad)
        for rest in ("-wal", "-shm", "-journal"):
            Path(f"{path}{rest}").unlink(missing_ok=True)
        try:
            found = UnfinishedRun.find(folder)
            found.sweep(job, CONFIG, CALIBRATION)
        except ConfigError:
            continue
        resumed += 1
        assert not parts or older, "of a part that was put down already"
        assert older or found.info["job_hash"] == job_hash(tmp_path / "pot.toml")
    # What is empty in the file may hold anything; all else was refused.
    assert resumed < (250 if older else 25)


COLUMNS = {
    "runs": ("info", "outcome", "started", "pid"),
    "steps": ("name", "result", "ended", "state"),
    "events": ("at", "kind", "data"),
}


def test_a_journal_with_another_type_in_a_row_is_no_traceback(tmp_path: Path) -> None:
    folder = placing(tmp_path, "unknown", "released")
    data = (folder / FILE_NAME).read_bytes()
    for table, column in ((table, column) for table, columns in COLUMNS.items() for column in columns):
        for value in (None, 7, 7.5, "x", "[]", "{", '{"part": NaN}', b"\xff\xfe", "null", '{"part": []}'):
            (folder / FILE_NAME).write_bytes(data)
            base = sqlite3.connect(folder / FILE_NAME, isolation_level=None)
            with suppress(sqlite3.IntegrityError):
                base.execute(f"UPDATE {table} SET {column} = ?", (value,))
            base.close()
            with pytest.raises(ConfigError):
                UnfinishedRun.find(folder)
            assert run_row(folder)["outcome"] in ("unreadable", "not ended")
            assert not is_going(folder)


@pytest.mark.parametrize("key", ["job_file", "job_hash", "simulated", "seed", "level", "clock", "speed", "until"])
def test_facts_of_another_type_are_refused_by_name(tmp_path: Path, key: str) -> None:
    run, _ = cut_short(tmp_path)
    Journal(run.folder, "later", {**run.info, key: {"a": 1}}).close()
    with pytest.raises(ConfigError, match=f"tells its {key} as"):
        UnfinishedRun.find(run.folder)


def test_a_sweep_is_not_read_once_a_figure_was_edited_or_two_of_its_frames_are_exchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = sweep()
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
    # Who looks at an old run reads it as it is.
    np.savez(tmp_path / FILE, **{**data, "format": np.array(UNSEALED)})
    assert len(StoredSweep.load(tmp_path, *given, as_written=False).sweep.swaths) == 1
    np.savez(tmp_path / FILE, **{**data, "format": np.array(UNSEALED - 1)})
    with pytest.raises(RefusedError, match=f"format {UNSEALED - 1}, this program reads"):
        StoredSweep.load(tmp_path, *given, as_written=False)


@pytest.mark.parametrize("name", ["rail", "times", "flanges", "line_spread", "covariance"])
def test_a_sweep_with_a_figure_that_is_no_number_is_refused_whoever_wrote_it(tmp_path: Path, name: str) -> None:
    taken = sweep()
    values = getattr(taken, name).copy()
    values.flat[1] = np.nan
    save_sweep(tmp_path, SweepRecord((replace(taken, **{name: values}),)), fix(BOARD))
    with pytest.raises(RefusedError, match=f"{name} of .* holds what is no number"):
        StoredSweep.load(tmp_path, CALIBRATION.scan, load_job("pot")[0].scan, CONFIG.laser.exit_point, as_written=False)


@pytest.mark.parametrize("wrong", [np.zeros((6, 6)), -np.eye(6)], ids=["zero", "negative"])
def test_a_sweep_whose_board_has_no_covariance_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: np.ndarray
) -> None:
    taken = sweep()
    save_sweep(tmp_path, SweepRecord((taken,)), replace(fix(BOARD), covariance=wrong))
    monkeypatch.setattr(stored_sweep, "_swath", lambda *given: taken)
    with pytest.raises(RefusedError, match="board_covariance"):
        StoredSweep.load(tmp_path, CALIBRATION.scan, load_job("pot")[0].scan, CONFIG.laser.exit_point, as_written=False)


@pytest.mark.parametrize("outcome", ["placed", "done", "refused"])
def test_a_run_that_came_to_its_end_is_not_resumed(tmp_path: Path, outcome: str) -> None:
    """One that was to end after a step would drive on and place."""
    journal = Journal(tmp_path, "run", {"until": "invert_pose"})
    journal.run_ended(outcome, "all steps done")
    journal.close()
    with pytest.raises(ConfigError, match=f"has ended {outcome}"):
        UnfinishedRun.find(tmp_path)


def test_a_run_that_a_script_looked_at_is_resumed_with_a_script_only(tmp_path: Path) -> None:
    run, _ = cut_short(tmp_path, scripted=True)
    assert run.info["scripted"]
    with pytest.raises(ConfigError, match="was looked at by a script"):
        UnfinishedRun.find(run.folder)
