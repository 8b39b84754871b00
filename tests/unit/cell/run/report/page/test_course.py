"""Where steps and faults stand in the time of a run, and which runs it is shown among."""

import json
import time
from pathlib import Path
from typing import Any

import pytest

from cell.base.storage import write_json
from cell.run.record.file import RecordFile
from cell.run.report.page.course import (
    RAIL_M_S,
    SWITCH_S,
    Activity,
    Past,
    Timeline,
    Trend,
    activities,
    idle,
    past_runs,
    timeline,
)
from lab.bench.job.whole_job import JobRecord
from statemachine.journal import Journal

BEGUN = 100.0


def recorded(folder: Path, *told: tuple[str, float, dict[str, object]]) -> list[Activity]:
    """What the activities are of messages at these times, s since the first step began."""
    out = RecordFile(folder / "record.mcap", {}, lossless=True)
    begin = ("/sequence/event", 0.0, {"kind": "step_started", "step": "place", "data": {}})
    for topic, at, message in (begin, *told):
        out.put(topic, round(1e9 * (BEGUN + at)), lambda message=message: json.dumps(message).encode())
    out.close()
    return activities(folder)


def arm(at: float, speed: float) -> tuple[str, float, dict[str, object]]:
    return "/arm/state", at, {"joints": [at] * 6, "joint_speeds": [0.0, speed, 0.0, 0.0, 0.0, 0.0]}


def rail(at: float, name: str, **arguments: float) -> tuple[str, float, dict[str, object]]:
    return "/rail/command", at, {"name": name, "arguments": arguments, "refused": ""}


def test_an_arm_moves_from_its_last_state_at_rest_to_its_last_in_motion(tmp_path):
    # What a motion recorded by itself may come after what is told later.
    found = recorded(tmp_path, arm(1.0, 0.0), arm(2.0, 0.5), arm(4.0, 0.0), arm(3.0, -0.5), arm(9.0, 0.0))
    (moved,) = found
    assert (moved.device, moved.begin, moved.end) == ("arm", pytest.approx(1.0), pytest.approx(3.0))
    assert moved.first is not None and moved.first["joints"] == [1.0] * 6
    assert moved.last is not None and moved.last["joints"] == [3.0] * 6
    assert moved.words == "arm moves, 2.00 s"


def test_a_rail_is_on_its_way_until_it_must_be_there_or_tells_more(tmp_path):
    found = recorded(
        tmp_path, rail(1.0, "move_to", position=0.02), rail(5.0, "sweep", start=0.02, stop=0.08, speed=0.015),
        ("/rail/state", 9.2, {"position": 0.08, "homed": True}), rail(10.0, "move_to", position=0.0),
    )  # fmt: skip
    begins, ends = [one.begin for one in found], [one.end for one in found]
    assert begins == pytest.approx([1.0, 5.0, 10.0])
    assert ends == pytest.approx([1.0 + 0.02 / RAIL_M_S + 0.02, 9.2, 10.0 + 0.08 / RAIL_M_S + SWITCH_S])


def test_a_laser_is_lit_until_it_is_off_and_pictures_close_together_are_one_look(tmp_path):
    def laser(at: float, name: str) -> tuple[str, float, dict[str, object]]:
        return "/laser/command", at, {"name": name, "arguments": {}, "refused": ""}

    pictures = [("/scan_camera/frame", at, {"frame_id": 1}) for at in (2.0, 2.1, 2.4, 5.0)]
    found = recorded(tmp_path, laser(1.0, "lit"), laser(3.0, "off"), laser(8.0, "stop"), *pictures)
    assert [(one.device, one.pictures) for one in found] == [("laser", 0), ("scan_camera", 3), ("scan_camera", 1)]
    assert [one.end for one in found] == pytest.approx([3.0, 2.4, 5.02])
    assert idle(found, 6.0) == [(0.0, pytest.approx(1.0)), (3.0, pytest.approx(5.0)), (pytest.approx(5.02), 6.0)]


def test_what_was_refused_is_not_drawn_and_a_laser_that_nobody_put_out_is(tmp_path):
    lit = {"name": "lit", "arguments": {}}
    refused = "/laser/command", 1.0, {**lit, "refused": "the vehicle drives"}
    found = recorded(
        tmp_path, refused, ("/laser/command", 4.0, lit), arm(5.0, 0.0), ("/arm/state", 6.5, {"joint_speeds": []})
    )
    assert [(one.device, one.begin, one.end) for one in found] == [("laser", pytest.approx(4.0), pytest.approx(6.5))]


def test_of_a_whole_job_the_arm_and_the_vehicle_never_move_at_once(placed_pot: JobRecord):
    found = activities(placed_pot.folder)
    moves = {name: [one for one in found if one.device == name] for name in ("arm", "vehicle", "rail", "laser")}
    assert all(moves.values())
    for one in moves["vehicle"]:
        assert not any(min(one.end, other.end) - max(one.begin, other.begin) > 0.1 for other in moves["arm"])
    # Waits are rare: where nothing is done, the arm settles.
    length = max(one.end for one in found)
    assert sum(end - begin for begin, end in idle(found, length)) < 0.15 * length


def test_without_a_record_there_are_none(tmp_path):
    assert activities(tmp_path) == []
    (tmp_path / "record.mcap").write_bytes(b"no record")
    assert activities(tmp_path) == []


def test_steps_follow_each_other_in_the_cells_time_on_the_virtual_clock(tmp_path):
    journal = Journal(tmp_path, "run", {"clock": "virtual"})
    for attempt, error in ((1, "frames were lost"), (2, None)):
        journal.step_ended(journal.step_started("laser_sweep", attempt), 2.0 * attempt, {}, error)
    journal.close()
    fault = {"step": "laser_sweep", "attempt": 1, "code": "c", "reason": "r", "remedy": "tried again"}
    course = timeline(tmp_path, {"clock": "virtual", "faults": [fault]})
    assert [(bar.begin, bar.end, bar.state) for bar in course.bars] == [(0.0, 2.0, "failed"), (2.0, 6.0, "done")]
    assert [mark.at for mark in course.marks] == [2.0]


def test_steps_and_faults_stand_where_the_wall_had_them(tmp_path):
    journal = Journal(tmp_path, "run", {})
    key = journal.step_started("laser_sweep", 1)
    journal.event("confirm_needed", "laser_sweep", {"number": 1, "reason": "look at the arm"})
    journal.step_ended(key, 1.0, None, "protective stop")
    journal.close()
    at = time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(time.time() + 3600))
    fault = {"at": at, "step": "laser_sweep", "attempt": 1, "code": "c", "reason": "r", "remedy": "ended the run"}
    course = timeline(tmp_path, {"clock": "wall", "faults": [fault]})
    assert [(bar.step, bar.state) for bar in course.bars] == [("laser_sweep", "failed")]
    assert [mark.text.split(":")[0] for mark in course.marks] == ["confirm needed", "c in laser_sweep"]
    # A date of another clock does not leave the drawing.
    assert all(0.0 <= mark.at <= course.length < 60.0 for mark in course.marks)


def test_the_trend_holds_the_runs_of_the_job_before_this_one(tmp_path):
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
def test_an_axis_has_few_ticks_at_round_places_and_ends_within_the_drawing(length: float, ticks: int):
    drawn = Timeline((), (), length, "on the wall").ticks
    assert len(drawn) == ticks
    assert drawn[0] == 0.0 and drawn[-1] <= length


def test_the_axis_of_the_trend_holds_every_value():
    past = Past("a", "", "placed", simulated=True, true_mm=0.9, stated_mm=None)
    assert Trend([past], 0.6).highest == pytest.approx(0.99)
    assert Trend([past], 2.0).ticks == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])
    assert str(past) == "a, , placed, true error 0.900 mm, simulated"
