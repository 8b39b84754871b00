"""Runs and their replay, read from their folders."""

import os

import pytest

from cell.apps.console.view.archive import Archive
from cell.run.folder import list_runs
from cell.run.session.supervisor import Cell


def test_runs_of_the_archive_are_read_from_their_folders(tmp_path):
    folder = tmp_path / "20260101T000000-abcd"
    (folder / "frames").mkdir(parents=True)
    (folder / "frames" / "board-01-000001.png").write_bytes(b"png")
    (tmp_path / "secret.png").write_bytes(b"png")
    report = (
        '{"outcome": "placed", "reason": "done", "job": "pot", "place_sigma": {"translation_mm": [0.03, 0.04, 0.0]}'
    )
    (folder / "report.json").write_text(report + ', "truth": {"error_mm": {"d": {"mean": 0.07}}}, "started": "2026"}')
    archive = Archive(tmp_path, tmp_path, 86_400.0)
    (row,) = archive.runs()
    assert (row["d_mean_mm"], row["expected_mm"], row["outcome"]) == (0.07, 0.05, "placed")
    (folder / "report.json").write_text((folder / "report.json").read_text().replace("0.07", "0.08"))
    os.utime(folder / "report.json", ns=(1, 1))
    assert archive.runs()[0]["d_mean_mm"] == 0.08, "a run writes it again, with what takes long to reckon"
    (point,) = archive.trend()
    assert point["run"] == folder.name
    run = archive.run(folder.name)
    assert run is not None and run["pictures"] == ["board-01-000001.png"]
    assert archive.picture(folder.name, "board-01-000001.png") is not None
    assert archive.replay(folder.name) is None
    (folder / "linked.png").symlink_to(tmp_path / "secret.png")
    (folder / "trace.json").symlink_to(tmp_path / "secret.png")
    for name in ("../secret.png", "..", "secret.png", "linked.png"):
        assert archive.picture(folder.name, name) is None
    assert archive.run("..") is None
    assert archive.replay(folder.name) is None and archive.page(folder.name) is None
    # A pipe would keep whoever reads it waiting, and a linked run lies elsewhere.
    piped = tmp_path / "20260102T000000-abcd"
    piped.mkdir()
    os.mkfifo(piped / "report.json")
    (tmp_path / "20260103T000000-abcd").symlink_to(folder)
    assert [row["run"] for row in archive.runs()] == [folder.name]
    assert archive.run(piped.name) is None and archive.run("20260103T000000-abcd") is None


def test_the_cells_health_is_what_the_command_tells(tmp_path):
    told = Archive(tmp_path, tmp_path, 86_400.0).health()
    assert told is not None and (told["parts"], told["due"]) == ([], "no job has run yet: nothing is known")


def test_a_run_that_no_console_has_seen_is_replayed_from_its_record(cell: Cell):
    cell.home()
    folder = list_runs(cell.runs_folder)[-1]
    archive = Archive(cell.runs_folder, cell.runs_folder, 86_400.0)
    run, told = archive.run(folder.name), archive.replay(folder.name)
    assert run is not None and run["replay"]
    assert told is not None and told["times"][-1] > 1.0
    assert told["joints"][-1] == pytest.approx(list(cell.devices.arm.state().joints), abs=1e-3)
    assert len(told["times"]) == len(told["joints"]) == len(told["rail"]) == len(told["vehicle"])
    # Where the record is cut off it is read as far as it goes; where it tells nothing, nothing is offered.
    record = folder / "record.mcap"
    record.write_bytes(record.read_bytes()[: record.stat().st_size // 2])
    assert Archive(cell.runs_folder, cell.runs_folder, 86_400.0).replay(folder.name) is not None
    record.write_bytes(record.read_bytes()[:60])
    archive = Archive(cell.runs_folder, cell.runs_folder, 86_400.0)
    assert not (archive.run(folder.name) or {"replay": True})["replay"] and archive.replay(folder.name) is None
