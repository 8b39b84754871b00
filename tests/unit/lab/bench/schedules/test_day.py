"""Schedules as data, what is drawn and shrunk of them, the files of a process that is gone, and a computer's disk."""

import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from lab.bench.schedules.acts import Computer, LeftRun
from lab.bench.schedules.causes import CAUSES, named
from lab.bench.schedules.day import DayRecord
from lab.bench.schedules.schedule import ACTS, Entry, Schedule, draw
from lab.bench.schedules.search import command, steps_of, summary
from lab.bench.schedules.shrink import shrunk
from sim_backends.direct.cell import NAMES as FAULTS
from statemachine.journal import Journal, JournalError, read

JOBS = [("pot", ("drive_to_target", "place")), ("load", ("pick_nest",))]


def test_a_schedule_goes_to_a_line_of_json_and_back():
    schedule = Schedule("pot", 3, entries=(Entry("pause", "place", 0.5, 3.0, "part_taken"), Entry("kill")))
    assert Schedule.from_json(schedule.as_json()) == schedule
    assert "\n" not in schedule.as_json()
    assert command(schedule).startswith("cell bench schedules --schedule '{")
    for wrong in ("{}", "[]", '{"job": "pot", "seed": 1, "entries": [{"act": "earthquake"}]}', "nothing"):
        with pytest.raises(ValueError):
            Schedule.from_json(wrong)


def test_the_same_seed_draws_the_same_and_all_acts_come():
    drawn = [draw(seed, JOBS, ["nominal", "workshop"], [1, 2]) for seed in range(300)]
    assert drawn[7] == draw(7, JOBS, ["nominal", "workshop"], [1, 2])
    assert {entry.act for schedule in drawn for entry in schedule.entries} == {*FAULTS, *ACTS}
    assert {schedule.level for schedule in drawn} == {"nominal", "workshop"}
    assert all(1 <= len(schedule.entries) <= 4 for schedule in drawn)
    only = draw(1, JOBS[:1], ["nominal"], [1], lambda step, act: float((step, act) == ("place", "kill")) + 1e-9)
    assert ("place", "kill") in {(entry.step, entry.act) for entry in only.entries}


def test_what_breaks_a_rule_is_shrunk_to_what_it_takes():
    asked: list[Schedule] = []

    def breaks(schedule: Schedule) -> bool:
        asked.append(schedule)
        return any(entry.act == "kill" and entry.share >= 0.2 for entry in schedule.entries)

    entries = Entry("abort"), Entry("kill", "place", 0.9, 8.0, "part_taken"), Entry("rail.reset")
    smallest = shrunk(Schedule("pot", 1, "workshop", entries), breaks, tries=40)
    assert smallest == Schedule("pot", 1, "nominal", (Entry("kill", "place", 0.23, 1.0),))
    assert len(asked) < 40


def journal(folder: Path) -> Journal:
    made = Journal(folder, "run", {"kind": "job"})
    for number in range(3):
        made.event("note", "place", {"number": number})
    return made


def test_a_process_that_is_gone_leaves_its_journal_as_it_was_then(tmp_path):
    writes = journal(tmp_path)
    left = LeftRun.taken(tmp_path, Entry("kill"))
    writes.run_ended("aborted", "later")
    writes.close()
    left.restore()
    record = read(tmp_path, whole=True)
    assert not record.finished
    assert [event.data["number"] for event in record.events] == [0, 1, 2]


@pytest.mark.parametrize(("amount", "events"), [(0.0, 2), (0.79, 2), (0.8, None), (0.99, None)])
def test_a_power_cut_tears_the_newest_page_or_the_base(tmp_path, amount: float, events: int | None):
    writes = journal(tmp_path)
    left = LeftRun.taken(tmp_path, Entry("power_cut", amount=amount))
    writes.close()
    left.restore()
    if events is not None:
        assert len(read(tmp_path, whole=True).events) == events
        return
    with suppress(JournalError):
        assert len(read(tmp_path, whole=True).events) == 3


def test_a_full_disk_takes_nothing_until_there_is_room_again(tmp_path):
    with Computer() as computer:
        writes = journal(tmp_path)
        computer.fill_disk()
        with pytest.raises(JournalError, match="cannot be written"):
            for _ in range(100):
                writes.event("note", None, {"text": "x" * 500})
        computer.free_disk()
        writes.event("note", None, {"text": "again"})
        writes.close()
    assert read(tmp_path).events[-1].data == {"text": "again"}


def test_the_wall_clock_is_set_and_set_back():
    before = time.time()
    with Computer() as computer:
        computer.step_clock(-3600.0)
        assert time.time() == pytest.approx(before - 3600.0, abs=5.0)
        assert time.strftime("%Y%m%dT%H%M%S") < time.strftime("%Y%m%dT%H%M%S", time.localtime(before - 60.0))
    assert time.time() == pytest.approx(before, abs=5.0)


def test_each_fault_and_act_that_may_end_a_run_has_its_words():
    silent = {"pause", "late_word", "kill", "power_cut"}
    assert {*FAULTS, *ACTS} - set(CAUSES) == silent
    assert named("arm: the emergency stop is pressed", ["arm.emergency_stop"], "nominal")
    assert not named("arm: the emergency stop is pressed", ["rail.reset"], "nominal")


def test_the_table_counts_what_met_and_tells_what_never_did():
    record = DayRecord(Schedule("pot", 1), (("placed", ""),), (("place", "pause", "placed"),), ())
    told = summary([record, replace(record, met=(("place", "pause", "refused"),))], JOBS)
    assert told["met"] == [{"step": "place", "act": "pause", "placed": 1, "refused": 1}]
    assert "pause" not in told["never_met"]["place"] and "kill" in told["never_met"]["place"]


def test_a_job_of_several_items_is_each_of_them():
    assert [name for name, _ in steps_of(["tray4"])] == ["tray4#1", "tray4#2", "tray4#3", "tray4#4"]
    assert steps_of(["pot"])[0][1][0] == "drive_to_target"
