"""Bars of what each device did stand where its record has them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cell.run.record.file import RecordFile
from cell.run.report.page.activities import RAIL_M_S, SWITCH_S, Activity, activities, idle
from lab.bench.job.whole_job import JobRecord

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


def test_an_arm_moves_from_its_last_state_at_rest_to_its_last_in_motion(tmp_path: Path) -> None:
    # What a motion recorded by itself may come after what is told later.
    found = recorded(tmp_path, arm(1.0, 0.0), arm(2.0, 0.5), arm(4.0, 0.0), arm(3.0, -0.5), arm(9.0, 0.0))
    (moved,) = found
    assert (moved.device, moved.begin, moved.end) == ("arm", pytest.approx(1.0), pytest.approx(3.0))
    assert moved.first is not None and moved.first["joints"] == [1.0] * 6
    assert moved.last is not None and moved.last["joints"] == [3.0] * 6
    assert moved.words == "arm moves, 2.00 s"


def test_a_rail_is_on_its_way_until_it_must_be_there_or_tells_more(tmp_path: Path) -> None:
    found = recorded(
        tmp_path, rail(1.0, "move_to", position=0.02), rail(5.0, "sweep", start=0.02, stop=0.08, speed=0.015),
        ("/rail/state", 9.2, {"position": 0.08, "homed": True}), rail(10.0, "move_to", position=0.0),
    )  # fmt: skip
    begins, ends = [one.begin for one in found], [one.end for one in found]
    assert begins == pytest.approx([1.0, 5.0, 10.0])
    assert ends == pytest.approx([1.0 + 0.02 / RAIL_M_S + 0.02, 9.2, 10.0 + 0.08 / RAIL_M_S + SWITCH_S])


def test_a_laser_is_lit_until_it_is_off_and_pictures_close_together_are_one_look(tmp_path: Path) -> None:
    def laser(at: float, name: str) -> tuple[str, float, dict[str, object]]:
        return "/laser/command", at, {"name": name, "arguments": {}, "refused": ""}

    pictures = [("/scan_camera/frame", at, {"frame_id": 1}) for at in (2.0, 2.1, 2.4, 5.0)]
    found = recorded(tmp_path, laser(1.0, "lit"), laser(3.0, "off"), laser(8.0, "stop"), *pictures)
    assert [(one.device, one.pictures) for one in found] == [("laser", 0), ("scan_camera", 3), ("scan_camera", 1)]
    assert [one.end for one in found] == pytest.approx([3.0, 2.4, 5.02])
    assert idle(found, 6.0) == [(0.0, pytest.approx(1.0)), (3.0, pytest.approx(5.0)), (pytest.approx(5.02), 6.0)]


def test_what_was_refused_is_not_drawn_and_a_laser_that_nobody_put_out_is(tmp_path: Path) -> None:
    lit = {"name": "lit", "arguments": {}}
    refused = "/laser/command", 1.0, {**lit, "refused": "the vehicle drives"}
    found = recorded(
        tmp_path, refused, ("/laser/command", 4.0, lit), arm(5.0, 0.0), ("/arm/state", 6.5, {"joint_speeds": []})
    )
    assert [(one.device, one.begin, one.end) for one in found] == [("laser", pytest.approx(4.0), pytest.approx(6.5))]


def test_of_a_whole_job_the_arm_and_the_vehicle_never_move_at_once(placed_pot: JobRecord) -> None:
    assert placed_pot.folder is not None
    found = activities(placed_pot.folder)
    moves = {name: [one for one in found if one.device == name] for name in ("arm", "vehicle", "rail", "laser")}
    assert all(moves.values())
    for one in moves["vehicle"]:
        assert not any(min(one.end, other.end) - max(one.begin, other.begin) > 0.1 for other in moves["arm"])
    # Waits are rare: where nothing is done, the arm settles.
    length = max(one.end for one in found)
    assert sum(end - begin for begin, end in idle(found, length)) < 0.15 * length


def test_without_a_record_there_are_none(tmp_path: Path) -> None:
    assert activities(tmp_path) == []
    (tmp_path / "record.mcap").write_bytes(b"no record")
    assert activities(tmp_path) == []
