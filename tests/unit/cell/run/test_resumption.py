"""A run is resumed with its own job, and its sweep is trusted only as long as nothing that it stands on has changed."""

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cell.config.job import load_job
from cell.procedures.steps.pick import HeldPart
from cell.procedures.sweep.stored_sweep import FILE
from cell.run.folder import is_going, run_row
from cell.run.resumption import UnfinishedRun, job_hash, job_source
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import job_with_part
from statemachine.journal import FILE_NAME, Journal
from tests.unit.cell.config.calibrations.test_store import made
from tests.unit.cell.procedures.sweep.test_sweeping import CONFIG

CALIBRATION = made()


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
def test_a_run_whose_job_was_changed_is_not_resumed(tmp_path, name: str):
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
def test_a_sweep_is_not_read_under_another_calibration_or_configuration(tmp_path, other: dict[str, Any], said: str):
    run, job = cut_short(tmp_path, **other)
    sweep, why = run.sweep(load_job(job)[0], CONFIG, CALIBRATION)
    assert sweep is None
    assert said in why


DECIDED = {"reason": "too few points", "again": "board_photo", "why": "wiped"}


@pytest.mark.parametrize(
    "then",
    [
        lambda journal: journal.event("decided", "invert_pose", DECIDED),
        lambda journal: journal.step_ended(journal.step_started("laser_sweep", 2), 1.0, error="the arm was pushed"),
        lambda journal: journal.step_started("laser_sweep", 1),
    ],
    ids=["rejected", "failed", "begun again"],
)
def test_a_sweep_that_did_not_stay_the_last_word_is_not_used(tmp_path, then: Callable[[Journal], None]):
    run, job = cut_short(tmp_path)
    journal = Journal(run.folder, "later", run.info)
    journal.step_ended(journal.step_started("laser_sweep", 1), 1.0, {})
    then(journal)
    journal.close()
    sweep, why = UnfinishedRun.find(run.folder).sweep(load_job(job)[0], CONFIG, CALIBRATION)
    assert sweep is None
    assert "had not finished its sweep" in why


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
def test_a_part_that_is_not_known_to_be_held_is_looked_at_first(tmp_path, parts: tuple[str, ...]):
    with pytest.raises(ConfigError, match=r"[Ll]ook (at the part|what has become)"):
        UnfinishedRun.find(placing(tmp_path, *parts))


def test_how_a_part_from_its_nest_is_held_is_known_until_it_is_gripped_again(tmp_path):
    told = HeldPart(pin.SE3.Identity(), 1e-8 * np.eye(6)).as_dict()
    run, _ = cut_short(tmp_path)
    journal = Journal(run.folder, "later", run.info)
    for more in ({"part": "unknown"}, {"part": "held"}, {"part": "held", "held": told}):
        journal.event("note", "pick", more)
    held = UnfinishedRun.find(run.folder).held
    assert held is not None and held.as_dict() == told
    journal.event("note", "verify", {"part": "held"})
    journal.close()
    with pytest.raises(ConfigError, match="how the claw holds it is not known"):
        UnfinishedRun.find(run.folder)
    Journal(run.folder, "last", {**run.info, "held": {**told, "covariance": [0.0]}}).close()
    with pytest.raises(ConfigError, match="how the claw holds it is not known"):
        UnfinishedRun.find(run.folder)


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
    tmp_path, parts: tuple[str, ...], older: bool
):
    folder = placing(tmp_path, *parts)
    whole = None if parts else UnfinishedRun.find(folder)
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
        # What is empty in the file may hold anything; all else was refused.
        assert older or found == whole
    assert resumed < (250 if older else 50)


COLUMNS = {
    "runs": ("info", "outcome", "started", "pid"),
    "steps": ("name", "result", "ended", "state"),
    "events": ("at", "kind", "data"),
}


def test_a_journal_with_another_type_in_a_row_is_no_traceback(tmp_path):
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


def test_a_changed_mesh_of_the_part_is_a_changed_job(tmp_path):
    job = job_with_part(tmp_path, "pot")
    before, told = job_hash(job), job_source(job)
    assert told["part_mesh"]["file"] == str(tmp_path / "pot-part.ply")
    assert job_hash(job) == before
    (tmp_path / "pot-part.ply").write_bytes((tmp_path / "pot-part.ply").read_bytes() + b"\n")
    assert job_hash(job) != before
    (tmp_path / "pot-part.ply").unlink()
    with pytest.raises(
        ConfigError, match=r"part\.mesh 'pot-part\.ply' is not a file \(looked for .*\); name an STL or PLY"
    ):
        job_hash(job)


@pytest.mark.parametrize("key", ["job_file", "job_hash", "simulated", "seed", "level", "clock", "speed", "until"])
def test_facts_of_another_type_are_refused_by_name(tmp_path, key: str):
    run, _ = cut_short(tmp_path)
    Journal(run.folder, "later", {**run.info, key: {"a": 1}}).close()
    with pytest.raises(ConfigError, match=f"tells its {key} as"):
        UnfinishedRun.find(run.folder)


@pytest.mark.parametrize("outcome", ["placed", "done", "refused"])
def test_a_run_that_came_to_its_end_is_not_resumed(tmp_path, outcome: str):
    """One that was to end after a step would drive on and place."""
    journal = Journal(tmp_path, "run", {"until": "invert_pose"})
    journal.run_ended(outcome, "all steps done")
    journal.close()
    with pytest.raises(ConfigError, match=f"has ended {outcome}"):
        UnfinishedRun.find(tmp_path)


def test_a_run_that_a_script_looked_at_is_resumed_with_a_script_only(tmp_path):
    run, _ = cut_short(tmp_path, scripted=True)
    assert run.info["scripted"]
    with pytest.raises(ConfigError, match="was looked at by a script"):
        UnfinishedRun.find(run.folder)


def later(run: UnfinishedRun, name: str, part: str, **info: Any) -> None:
    """A run after it, in the same folder."""
    folder = run.folder.parent / name
    folder.mkdir()
    journal = Journal(folder, name, {"job_file": run.job, **info})
    journal.event("note", "place", {"part": part})
    journal.run_ended("placed", "all steps done")
    journal.close()


def named(run: UnfinishedRun) -> UnfinishedRun:
    """The run under a name as `new_run` gives them."""
    return UnfinishedRun.find(run.folder.rename(run.folder.with_name("20261124T120000-aaaa")))


def test_a_run_is_resumed_once(tmp_path):
    """Its part is placed by the run that resumed it: the claw may hold the next one since."""
    run = named(cut_short(tmp_path)[0])
    later(run, "20261124T120001-bbbb", "released", resumed_from=run.folder.name)
    with pytest.raises(ConfigError, match="was resumed already, by run 20261124T120001-bbbb, which has ended placed"):
        UnfinishedRun.find(run.folder)


@pytest.mark.parametrize(
    ("name", "part", "said"),
    [
        ("20261124T120001-bbbb", "released", "a part was put down since, by run 20261124T120001-bbbb"),
        ("20261124T120001-bbbb", "unknown", "a part was put down since"),
        ("20261124T120001-bbbb", "held", "cannot be read as a sweep"),
        ("20261124T115959-bbbb", "released", "cannot be read as a sweep"),
    ],
)
def test_a_sweep_from_before_another_part_was_put_down_is_not_used(tmp_path, name: str, part: str, said: str):
    run = named(cut_short(tmp_path)[0])
    later(run, name, part)
    found = UnfinishedRun.find(run.folder)
    assert said in found.sweep(load_job(found.job)[0], CONFIG, CALIBRATION)[1]
