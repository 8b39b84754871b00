"""Where steps and faults stand in the time of a run, and which runs it is shown among."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from cell.run.folder import write_json
from cell.run.report.page.course import Past, Timeline, Trend, past_runs, timeline
from statemachine.journal import Journal


def test_steps_follow_each_other_in_the_cells_time_on_the_virtual_clock(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "run", {"clock": "virtual"})
    for attempt, error in ((1, "frames were lost"), (2, None)):
        journal.step_ended(journal.step_started("laser_sweep", attempt), 2.0 * attempt, {}, error)
    journal.close()
    fault = {"step": "laser_sweep", "attempt": 1, "code": "c", "reason": "r", "remedy": "tried again"}
    course = timeline(tmp_path, {"clock": "virtual", "faults": [fault]})
    assert course is not None
    assert [(bar.begin, bar.end, bar.state) for bar in course.bars] == [(0.0, 2.0, "failed"), (2.0, 6.0, "done")]
    assert [mark.at for mark in course.marks] == [2.0]


def test_steps_and_faults_stand_where_the_wall_had_them(tmp_path: Path) -> None:
    journal = Journal(tmp_path, "run", {})
    key = journal.step_started("laser_sweep", 1)
    journal.event("confirm_needed", "laser_sweep", {"number": 1, "reason": "look at the arm"})
    journal.step_ended(key, 1.0, None, "protective stop")
    journal.close()
    at = time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(time.time() + 3600))
    fault = {"at": at, "step": "laser_sweep", "attempt": 1, "code": "c", "reason": "r", "remedy": "ended the run"}
    course = timeline(tmp_path, {"clock": "wall", "faults": [fault]})
    assert course is not None
    assert [(bar.step, bar.state) for bar in course.bars] == [("laser_sweep", "failed")]
    assert [mark.text.split(":")[0] for mark in course.marks] == ["confirm needed", "c in laser_sweep"]
    # A date of another clock does not leave the drawing.
    assert all(0.0 <= mark.at <= course.length < 60.0 for mark in course.marks)


def test_the_trend_holds_the_runs_of_the_job_before_this_one(tmp_path: Path) -> None:
    def run(name: str, **facts: Any) -> Path:
        (tmp_path / name).mkdir()
        write_json(tmp_path / name / "report.json", {"outcome": "placed", "kind": "job", "job": "pot", **facts})
        return tmp_path / name

    run("20260101T000000-0001", place_bound_95={"d": 0.3}, truth={"error_mm": {"d": {"max": 0.1}}})
    run("20260101T000000-0002", job="seat")
    run("20260101T000000-0003", outcome="refused")
    here = run("20260101T000000-0004", place_bound_95={"d": 0.4})
    run("20260101T000000-0005")
    past = past_runs(here, json.loads((here / "report.json").read_text()))
    assert [(p.name[-4:], p.true_mm, p.stated_mm) for p in past] == [
        ("0001", 0.1, 0.3), ("0003", None, None), ("0004", None, 0.4),
    ]  # fmt: skip


@pytest.mark.parametrize(("length", "ticks"), [(0.1, 2), (1.0, 11), (47.0, 10), (80_000.0, 9)])
def test_an_axis_has_few_ticks_at_round_places_and_ends_within_the_drawing(length: float, ticks: int) -> None:
    drawn = Timeline((), (), length, "on the wall").ticks
    assert len(drawn) == ticks
    assert drawn[0] == 0.0 and drawn[-1] <= length


def test_the_axis_of_the_trend_holds_every_value() -> None:
    past = Past("a", "", "placed", simulated=True, true_mm=0.9, stated_mm=None)
    assert Trend([past], 0.6).highest == pytest.approx(0.99)
    assert Trend([past], 2.0).ticks == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])
    assert str(past) == "a, , placed, true error 0.900 mm, simulated"
