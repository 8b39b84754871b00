"""What is kept of a run for its replay."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cell.console.archive import Archive
from cell.console.trace import FILE, Trace, traced
from cell.run.folder import list_runs
from cell.run.run import Run
from cell.supervisor import Cell
from statemachine.step import Event


def test_the_steps_of_a_run_are_kept_with_their_times(cell: Cell, tmp_path: Path) -> None:
    def work(run: Run[None]) -> None:
        run.folder = tmp_path
        run.tell(Event("step_started", "drive", {"attempt": 1}))
        run.progress(0.5, "half-way")
        run.tell(Event("step_done", "drive", {"duration_s": 1.0}))
        run.tell(Event("step_started", "place", {"attempt": 1}))
        run.tell(Event("step_failed", "place", {"attempt": 1, "reason": "the test"}))

    run = Run("job", work)
    traced(cell.devices, run, Trace(cell.devices, virtual=True))
    steps = json.loads((tmp_path / FILE).read_text())["steps"]
    assert [step["name"] for step in steps] == ["drive", "place"]
    assert all(0 <= step["begin"] <= step["end"] for step in steps)


def test_a_run_that_no_console_has_seen_is_replayed_from_its_record(cell: Cell) -> None:
    cell.home()
    folder = list_runs(cell.runs_folder)[-1]
    assert not (folder / FILE).exists()
    archive = Archive(cell.runs_folder)
    run, told = archive.run(folder.name), archive.replay(folder.name)
    assert run is not None and run["replay"]
    assert told is not None and told["times"][-1] > 1.0
    assert told["joints"][-1] == pytest.approx(list(cell.devices.arm.state().joints), abs=1e-3)
    assert len(told["times"]) == len(told["joints"]) == len(told["rail"]) == len(told["vehicle"])
    # Where the record is cut off it is read as far as it goes; where it tells nothing, nothing is offered.
    record = folder / "record.mcap"
    record.write_bytes(record.read_bytes()[: record.stat().st_size // 2])
    assert Archive(cell.runs_folder).replay(folder.name) is not None
    record.write_bytes(record.read_bytes()[:60])
    archive = Archive(cell.runs_folder)
    run = archive.run(folder.name)
    assert run is not None and not run["replay"]
    assert archive.replay(folder.name) is None
