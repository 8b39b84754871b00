"""Run folders and the lock: one holder at a time, none left behind, and a held cell says who holds it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cell.config import load_config
from cell.runs import CellLock, find_run, list_runs, new_run, read_report, write_json
from drivers.errors import ConfigError, InterlockError
from statemachine.journal import Journal


@pytest.fixture(autouse=True)
def own_lock_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def test_a_cell_is_held_once_and_free_again_afterwards() -> None:
    lock = CellLock(load_config(None))
    with lock, pytest.raises(InterlockError, match=f"held by process {os.getpid()}"):
        CellLock(load_config(None)).__enter__()
    assert not lock.path.exists()
    with CellLock(load_config(None)):
        pass


def test_the_lock_of_a_killed_process_is_free(tmp_path: Path) -> None:
    script = (
        "import os, signal\nfrom cell.config import load_config\nfrom cell.runs import CellLock\n"
        "CellLock(load_config(None)).__enter__()\nos.kill(os.getpid(), signal.SIGKILL)\n"
    )
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    assert subprocess.run([sys.executable, "-c", script], env=env, timeout=60).returncode == -9
    with CellLock(load_config(None)):
        pass


def test_runs_are_found_by_name_id_or_as_the_newest(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    with pytest.raises(ConfigError, match="no run at all"):
        find_run(root, None)
    first = new_run(root)
    second = new_run(root)
    assert set(list_runs(root)) == {first, second}
    assert find_run(root, None) == sorted((first, second))[-1]
    assert find_run(root, first.name.split("-")[1]) == first
    with pytest.raises(ConfigError, match="no run nothing"):
        find_run(root, "nothing")


def test_a_run_without_a_report_tells_what_its_journal_does(tmp_path: Path) -> None:
    folder = new_run(tmp_path / "runs")
    journal = Journal(folder, folder.name, {"job": "pot"})
    journal.step_started("drive_to_target", 1)
    journal.close()
    report = read_report(folder)
    assert report["outcome"] == "not ended"
    assert report["job"] == "pot"
    assert report["steps"][0]["name"] == "drive_to_target"
    write_json(folder / "report.json", {"outcome": "placed"})
    assert read_report(folder) == {"outcome": "placed"}
