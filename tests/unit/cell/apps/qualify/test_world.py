"""One world by the product's runner: its row, what is kept of it, and the command that repeats it to the bit."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from cell import Cell
from cell.apps.qualify import world
from cell.apps.qualify.answer import repeat_command
from cell.apps.qualify.identity import QualifiedCode
from cell.apps.qualify.rows import Row
from cell.apps.qualify.world import WorldTask, run_world
from cell.config.cell_config import default_toml, load_config
from drivers.errors import Aborted, ConfigError, RefusedError
from tests.support import Typed
from tests.support.described_cells import quick_job
from tests.support.qualified import compared

SEED = 2


@pytest.fixture(scope="module")
def task(tmp_path_factory) -> WorldTask:
    """The job `pot`, swept in a quarter of the lines shipped."""
    folder = tmp_path_factory.mktemp("qualify")
    job = str(quick_job("pot", folder, 15.0))
    of = QualifiedCode.of(job, load_config(None))
    return WorldTask(of, job, default_toml(), folder / "campaign", level="nominal", seed=SEED)


@pytest.fixture(scope="module")
def row(task: WorldTask) -> Row:
    return run_world(task)


def test_a_world_is_a_row(row: Row, task: WorldTask):
    assert (row["outcome"], row["reason"], row["key"]) == ("placed", "", task.key)
    error, bound = row["true_error_max_mm"], row["stated_bound_mm"]
    assert 0.0 < error < bound < 0.6
    assert (row["points_covered"], row["place error, largest of 45 points [mm]"]) == (1.0, error)
    assert row["wall_s"] > 0.0


def test_of_its_runs_nothing_is_kept_but_the_calibration(row: Row, task: WorldTask):
    kept = sorted(path.name for path in task.folder.rglob("*") if path.is_file())
    assert kept[1:] == ["cell.toml"]
    assert kept[0].endswith("-TARGET.json")


def test_again_it_is_the_same_without_another_calibration(row: Row, task: WorldTask, monkeypatch):
    monkeypatch.setattr(Cell, "calibrate", None)
    again = run_world(task)
    assert again is not None
    assert compared(again) == compared(row)


def test_its_command_repeats_it(row: Row, task: WorldTask, here: Path, typed: Typed):
    words = repeat_command(row, task.job, str(task.config_file)).split()[1:]
    code, out, _ = typed(*words, "--json")
    assert code == 0
    report = json.loads(out)
    assert report["truth"]["error_mm"]["d"]["max"] == row["true_error_max_mm"]
    assert report["cell_s"] == row["cycle_s"]


def test_what_a_run_raises_is_a_row(task: WorldTask, monkeypatch):
    def raises(error: BaseException) -> Row | None:
        def work(*_: object) -> None:
            raise error

        monkeypatch.setattr(world, "_calibrate", lambda *_: None)
        monkeypatch.setattr(world, "_run", work)
        return run_world(task)

    made = raises(KeyError("x"))
    assert (made["outcome"], made["code"], made["reason"]) == ("error", "KeyError", "KeyError: 'x'")
    assert raises(Aborted("ended by a signal")) is None
    scratch = raises(OSError(f"no room in {task.config_file.parent}/calibrations"))
    assert scratch["reason"] == "OSError: no room in WORLD/calibrations", "the same in whichever folder"


def test_a_calibration_that_is_refused_is_a_row(task: WorldTask, monkeypatch):
    def refused(*_: object) -> None:
        raise RefusedError("the board is too dark")

    monkeypatch.setattr(world, "_calibrate", refused)
    made = run_world(task)
    assert (made["outcome"], made["step"], made["reason"]) == ("refused", "calibrate", "the board is too dark")


def test_a_worker_of_another_version_runs_nothing(task: WorldTask):
    with pytest.raises(ConfigError, match="install the same release"):
        run_world(replace(task, of=replace(task.of, code_hash="another")))
    with pytest.raises(ConfigError, match="cannot read"):
        run_world(replace(task, job=f"{task.job}x"))
