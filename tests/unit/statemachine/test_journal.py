"""The journal: what was written is there, whatever happened to the writer."""

import signal
import sqlite3
import subprocess
import sys
import threading

import pytest

from statemachine.journal import FILE_NAME, Journal, JournalError, read, request

WRITER = """
import sys
from pathlib import Path
from statemachine.journal import Journal
journal = Journal(Path(sys.argv[1]), "r1", {"seed": 7})
key = journal.step_started("board_photo", 1)
journal.step_ended(key, 1.5, {"residual_px": 0.08})
journal.step_started("laser_sweep", 1)
count = 0
while True:
    count += 1
    journal.event("note", "laser_sweep", {"line": count})
    print(count, flush=True)"""


def test_what_was_written_can_be_read_while_the_run_goes_on(tmp_path):
    journal = Journal(tmp_path, "r1", {"seed": 7, "level": "nominal"})
    failed = journal.step_started("board_photo", 1)
    journal.step_ended(failed, 0.5, error="no frame came")
    again = journal.step_started("board_photo", 2)
    journal.step_ended(again, 0.25, {"residual_px": 0.08})
    journal.event("note", "board_photo", {"views": 3})
    record = read(tmp_path)
    assert record.run.info == {"seed": 7, "level": "nominal"}
    assert not record.finished
    assert [(row.name, row.attempt, row.state, row.duration_s, row.error) for row in record.steps] == [
        ("board_photo", 1, "failed", 0.5, "no frame came"),
        ("board_photo", 2, "done", 0.25, None),
    ]
    assert (record.done, record.events[0].data) == ({"board_photo": {"residual_px": 0.08}}, {"views": 3})
    journal.run_ended("placed", "all steps done")
    assert read(tmp_path).run.outcome == "placed"
    journal.close()


def test_every_row_that_a_killed_writer_reported_is_there(tmp_path):
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    reported = 0
    while reported < 50:
        reported = int(writer.stdout.readline())
    writer.send_signal(signal.SIGKILL)
    rest, _ = writer.communicate(timeout=10)
    complete = [int(line) for line in rest.split("\n")[:-1]]
    reported = max([reported, *complete])
    record = read(tmp_path)
    assert [row.data["line"] for row in record.events][:reported] == list(range(1, reported + 1))
    assert len(record.events) <= reported + 1
    assert (record.done, record.steps[-1].state) == ({"board_photo": {"residual_px": 0.08}}, "running")
    assert not record.finished
    base = sqlite3.connect(tmp_path / FILE_NAME)
    assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    base.close()


def test_rows_are_synced_to_the_disk_one_by_one(tmp_path):
    journal = Journal(tmp_path, "r1")
    assert journal._base.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    assert journal._base.execute("PRAGMA synchronous").fetchone() == (2,)
    assert journal._base.isolation_level is None
    journal.close()


def test_requests_of_other_processes_are_taken_once_and_in_order(tmp_path):
    journal = Journal(tmp_path, "r1")
    request(tmp_path, "pause", "coffee")
    # A terminal of another encoding hands on bytes that are no text.
    request(tmp_path, "abort", "cell abort by J\udcf6rg")
    assert [(r.kind, r.reason) for r in journal.take_requests()] == [
        ("pause", "coffee"),
        ("abort", "cell abort by J\\udcf6rg"),
    ]
    assert journal.take_requests() == []
    with pytest.raises(ValueError, match="abort, pause, go-on, confirm"):
        request(tmp_path, "explode", "")
    journal.close()


def test_what_was_asked_of_an_earlier_run_does_not_concern_the_next(tmp_path):
    first = Journal(tmp_path, "first")
    first.step_ended(first.step_started("board_photo", 1), 1.0)
    first.close()
    request(tmp_path, "abort", "the first one")
    second = Journal(tmp_path, "second")
    assert second.take_requests() == []
    request(tmp_path, "pause", "this one")
    assert [asked.kind for asked in second.take_requests()] == ["pause"]
    second.close()
    record = read(tmp_path)
    assert (record.run.id, [run.id for run in record.runs]) == ("second", ["first", "second"])
    assert record.steps == ()


def test_several_threads_can_write(tmp_path):
    journal = Journal(tmp_path, "r1")
    threads = [
        threading.Thread(target=lambda: [journal.event("note", None, {"i": i}) for i in range(20)]) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert len(read(tmp_path).events) == 80
    journal.close()


def older(folder, change="", *values):
    """A journal without CRC and process, as older versions wrote it."""
    journal = Journal(folder, "r1", {"seed": 7})
    journal.step_ended(journal.step_started("board_photo", 1), 1.5, {"residual_px": 0.08})
    journal.close()
    with sqlite3.connect(folder / FILE_NAME) as base:
        for table in ("runs", "steps", "events"):
            base.execute(f"ALTER TABLE {table} DROP COLUMN crc")
        base.execute("ALTER TABLE runs DROP COLUMN pid")
        if change:
            base.execute(change, values)
    base.close()


def test_a_journal_of_an_older_version_is_read(tmp_path):
    older(tmp_path)
    record = read(tmp_path)
    assert (record.run.id, record.run.pid, record.done) == ("r1", None, {"board_photo": {"residual_px": 0.08}})


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("name", b"\x07", "is no text"),
        ("duration_s", float("inf"), "'inf' is no number"),
        ("started", "long ago", "'long ago' is no number"),
        ("result", "[1]", "is no table"),
    ],
)
def test_what_is_no_text_or_number_in_a_row_without_crc_is_damage(tmp_path, column, value, words):
    older(tmp_path, f"UPDATE steps SET {column} = ?", value)
    with pytest.raises(JournalError, match=f"is damaged: .*{words}"):
        read(tmp_path)


def test_a_missing_or_foreign_file_is_a_clear_error(tmp_path):
    with pytest.raises(JournalError, match="there is no journal"):
        read(tmp_path)
    with pytest.raises(JournalError, match="there is no journal"):
        request(tmp_path, "abort", "x")
    (tmp_path / FILE_NAME).write_text("not a data base at all" * 100)
    with pytest.raises(JournalError, match="cannot be used"):
        read(tmp_path)
    with pytest.raises(JournalError, match="cannot be opened"):
        Journal(tmp_path / "nowhere", "r1")


def test_an_end_is_told_though_its_reason_holds_bytes_that_are_no_text(tmp_path):
    journal = Journal(tmp_path, "r")
    journal.step_ended(journal.step_started("place", 1), 1.0, error="no job J\udcf6rg.toml")
    journal.run_ended("faulted", "no job J\udcf6rg.toml")
    record = read(tmp_path)
    assert record.run.reason == record.steps[0].error == "no job J\\udcf6rg.toml"
