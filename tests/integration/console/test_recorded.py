"""What the record of a run gives for its replay."""

from __future__ import annotations

import pytest

from cell.apps.console.view.archive import Archive
from cell.run.folder import list_runs
from cell.run.session.supervisor import Cell


def test_a_run_that_no_console_has_seen_is_replayed_from_its_record(cell: Cell) -> None:
    cell.home()
    folder = list_runs(cell.runs_folder)[-1]
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
    assert not (archive.run(folder.name) or {"replay": True})["replay"] and archive.replay(folder.name) is None
