"""Run folders: found by name, number or as the newest, and what goes on in them is told."""

import logging
import os
import sqlite3
import time
from pathlib import Path

import pytest

from cell.apps.cli.commands.runs import abort
from cell.base.storage import sealed, write_json
from cell.run.folder import (
    Question,
    awaited_word,
    find_going,
    find_run,
    is_going,
    list_runs,
    new_folder,
    new_run,
    read_report,
    run_log,
    run_row,
)
from drivers.errors import CellError, ConfigError
from statemachine.journal import Journal


def test_runs_are_found_by_name_id_or_as_the_newest(tmp_path):
    root = tmp_path / "runs"
    with pytest.raises(ConfigError, match="no run at all"):
        find_run(root, None)
    first = new_run(root)
    second = new_run(root)
    (root / "notes").mkdir()
    assert set(list_runs(root)) == {first, second}
    assert find_run(root, None) == sorted((first, second))[-1]
    assert find_run(root, first.name.split("-")[1]) == first
    with pytest.raises(ConfigError, match="no run nothing"):
        find_run(root, "nothing")
    # However a folder is written, it is known which runs come after it.
    (second / "journal.sqlite").touch()
    (tmp_path / "latest").symlink_to(second)
    assert find_run(root, str(tmp_path / "latest")) == find_run(root, str(second / ".." / second.name)) == second


def test_a_run_without_a_report_tells_what_its_journal_does(tmp_path):
    folder = new_run(tmp_path / "runs")
    journal = Journal(folder, folder.name, {"job": "pot"})
    journal.step_started("drive_to_target", 1)
    journal.close()
    report = read_report(folder)
    assert (report["outcome"], report["job"]) == ("not ended", "pot")
    assert report["steps"][0]["name"] == "drive_to_target"
    write_json(folder / "report.json", {"outcome": "placed"})
    assert read_report(folder) == {"outcome": "placed"}
    write_json(folder / "report.json", sealed({"outcome": "refused", "reason": "too rough"}))
    assert read_report(folder) == {"outcome": "refused", "reason": "too rough"}
    (folder / "report.json").write_text((folder / "report.json").read_text().replace("refused", "placed"))
    with pytest.raises(CellError, match=r"report\.json: it was changed after it was written"):
        read_report(folder)
    assert "it was changed" in run_row(folder)["reason"]


def test_what_is_going_on_is_found_and_what_has_ended_or_died_is_not(tmp_path):
    root = tmp_path / "runs"
    with pytest.raises(ConfigError, match="nothing is going on"):
        find_going(root, None)
    dead = new_run(root)
    Journal(dead, dead.name, {"kind": "job", "pid": 2**22 + 1}).close()
    ended = new_run(root)
    journal = Journal(ended, ended.name, {"kind": "calibration", "pid": os.getpid()})
    with pytest.raises(ConfigError, match="process died"):
        find_going(root, dead.name)
    assert find_going(root, None) == ended
    journal.run_ended("done", "calibration done")
    with pytest.raises(ConfigError, match="nothing is going on"):
        find_going(root, None)
    assert (find_run(root, None, "job"), find_run(root, None, "calibration")) == (dead, ended)


def test_what_a_run_waits_for_is_read_from_its_journal(tmp_path):
    folder = new_run(tmp_path / "runs")
    journal = Journal(folder, folder.name)
    assert awaited_word(folder) is None
    journal.event("confirm_needed", "laser_sweep", {"reason": "the arm has stopped", "code": "x", "number": 2})
    assert awaited_word(folder) == Question(2, "the arm has stopped")
    assert read_report(folder)["reason"] == "waits for a person, question 2: the arm has stopped"
    journal.event("confirmed", "laser_sweep", {"by": "Ann", "reason": "the arm has stopped"})
    assert awaited_word(folder) is None


def begun(root: Path, kind: str = "job") -> Journal:
    """Of a run that goes on as long as its journal is held: one that nobody holds is closed at some time."""
    folder = new_run(root)
    return Journal(folder, folder.name, {"kind": kind, "pid": os.getpid()})


@pytest.fixture
def two(here: Path) -> list[Journal]:
    """Of two runs that go on, the first by its name first."""
    return sorted([begun(here / "runs"), begun(here / "runs")], key=lambda journal: journal.run)


def test_of_two_that_go_on_one_has_to_be_named(here: Path, two: list[Journal]):
    with pytest.raises(ConfigError, match="more than one is going on"):
        find_going(here / "runs", None)
    assert find_going(here / "runs", two[0].run) == two[0].path.parent


def test_a_time_of_maintenance_takes_no_requests_and_keeps_no_run_from_being_asked(tmp_path):
    job, maintenance = begun(tmp_path), begun(tmp_path, "maintenance")
    assert is_going(maintenance.path.parent)
    assert find_going(tmp_path, None) == job.path.parent
    with pytest.raises(ConfigError, match="nothing is going on there"):
        find_going(tmp_path, maintenance.run)


def test_one_that_cannot_be_asked_keeps_no_other_from_being_asked_to_end(two: list[Journal]):
    first, other = two
    with sqlite3.connect(first.path.parent / "journal.sqlite") as base:
        base.execute("DROP TABLE requests")
    base.close()
    with pytest.raises(ConfigError, match=f"not asked to end: .*{first.run}"):
        abort()
    assert [request.kind for request in other.take_requests()] == ["abort"]


def test_a_run_that_ended_as_the_others_were_asked_to_end_is_no_failure(two: list[Journal], monkeypatch):
    said = []

    def echo(line: str) -> None:
        said.append(line)
        two[1].run_ended("placed", "all steps done")

    monkeypatch.setattr("typer.echo", echo)
    abort()
    assert said == [f"asked {two[0].run} to end", f"{two[1].run} has ended meanwhile"]


def test_a_process_that_took_over_the_number_of_a_dead_one_is_not_the_run(tmp_path):
    """It lives, and has not this journal open."""
    folder = new_run(tmp_path / "runs")
    Journal(folder, folder.name, {"kind": "job", "pid": os.getppid()}).close()
    assert not is_going(folder)


@pytest.mark.parametrize("days", [-30, 30])
def test_a_clock_that_was_set_does_not_end_a_run(tmp_path, monkeypatch, days: int):
    folder, now = new_run(tmp_path / "runs"), time.time()
    with monkeypatch.context() as set_to:
        set_to.setattr("time.time", lambda: now + days * 86400.0)
        journal = Journal(folder, folder.name, {"kind": "job", "pid": os.getpid()})
    assert is_going(folder)
    journal.close()
    assert not is_going(folder)


def test_the_newest_run_is_the_last_whatever_the_clock_says(tmp_path):
    """Summer time ends, or the clock is set back: names go on where they were."""
    (tmp_path / "20991231T235959-ffff").mkdir()
    made = [new_run(tmp_path) for _ in range(3)]
    assert [folder.name[:15] for folder in made] == ["21000101T000000", "21000101T000001", "21000101T000002"]
    assert find_run(tmp_path, None) == made[-1]


def test_what_is_logged_in_a_run_stands_in_its_folder(tmp_path):
    with run_log(tmp_path):
        logging.getLogger("cell.run").warning("the lamp flickers")
    logging.getLogger("cell.run").warning("after it")
    told = (tmp_path / "run.log").read_text(encoding="utf-8")
    assert "the lamp flickers" in told and "after it" not in told


def test_a_log_that_cannot_be_written_ends_nothing(tmp_path, capfd, monkeypatch):
    """Nor does it take the place of what went wrong. /dev/full is a disk without room."""
    # What commands of other tests show lies with the logger as well.
    monkeypatch.setattr(logging.getLogger("cell"), "handlers", [])
    (tmp_path / "run.log").symlink_to("/dev/full")
    with pytest.raises(ConfigError, match="the board is not seen"), run_log(tmp_path):
        logging.getLogger("cell.run").warning("nothing but this")
        raise ConfigError("the board is not seen")
    assert capfd.readouterr().err == ""


def test_a_folder_that_nothing_can_be_written_into_goes_again_and_hides_no_run(tmp_path):
    with pytest.raises(CellError, match="`df -h` tells"), new_folder(tmp_path) as folder:
        raise OSError(28, f"No space left on device: {folder}")
    assert list_runs(tmp_path) == []
