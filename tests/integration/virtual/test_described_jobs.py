"""Jobs of one's own from their files to `placed`, on the virtual clock: one after another in one world, and in cells
that are described otherwise than the one that ships."""

from pathlib import Path
from typing import Any

import pytest

from cell import Cell
from tests.support.described_cells import LEAN, Changes, described, pose, write_saddle

FAST: Changes = {"scan": {"speed": '"30 mm/s"'}}
SADDLE: Changes = {
    "surface": {"mesh": '"saddle.ply"', "mesh_unit": '"mm"'},
    "grasp": {"size": '["60 mm", "30 mm", "20 mm"]'},
    "scan": {"speed": '"30 mm/s"', "length": '"56 mm"'},
}


def require_placed(report: dict[str, Any]) -> None:
    """Placed, without a collision, about as well as the noise that the world assumes lets expect."""
    assert (report["outcome"], report["end_state"]["collisions"]) == ("placed", [])
    truth = report["truth"]
    assert truth["error_mm"]["d"]["mean"] / truth["bound_mm"] <= 1.5


def test_one_job_after_another_in_one_world(calibrated_folder: Path):
    """The second has a surface of its own; the claw is filled again, and the vehicle stays where it sees the board."""
    cell, pot = described(calibrated_folder, LEAN, FAST)
    _, saddle = described(calibrated_folder / "saddle", None, SADDLE)
    write_saddle(saddle.parent / "saddle.ply")
    with Cell.open(cell, sim="all", clock="virtual", seed=2, job=pot) as opened:
        first, second = opened.run(pot), opened.run(saddle)
    require_placed(first.report)
    require_placed(second.report)
    assert second.report["part"] == "released"
    poses = [dict(run.report["truth"]) for run in (first, second)]
    assert poses[0] != poses[1]


CELLS: dict[str, tuple[int, Changes, Changes]] = {
    "own mesh": (3, {}, SADDLE),
    "lead, steps and microsteps": (4, {"rail": {"lead": '"5 mm"', "microsteps": "64", "steps_per_turn": "400"}}, FAST),
    "travel": (3, {"rail": {"travel": '["0 mm", "160 mm"]'}}, FAST),
    "baseline and angle": (3, {"laser": {"baseline": '"45 mm"', "tan_theta": "2.8"}}, FAST),
    "lens and sensor": (4,
        {"scan_camera": {"focal_length": '"12 mm"', "width": "1024", "height": "768"}},
        FAST,
    ),
    "board's pitch and place": (3,
        {},
        {**FAST, "board": {
            "spec": '"marked_dots:9x7:15mm"', "place_from_board": pose((100, 360, 140), (-135, 0, -90)),
        }},
    ),
    "tool turned by a quarter": (3,
        {
            "scan_camera": {"flange_from_camera": pose((-50, -90, 80), (0, 0, 0))},
            "target_camera": {"flange_from_camera": pose((0, 100, 30), (0, 0, 0))},
        },
        FAST,
    ),
    "a UR5e, with boards and station in its reach": (
        4,
        {
            "arm": {"model": '"UR5e"'},
            "calibration.fine": {"base_from_board": pose((-415, 112, 20), (180, 0, 0))},
            "calibration.large": {"base_from_board": pose((-280, -190, 20), (180, 0, 0))},
        },
        {
            **FAST,
            "approach": {
                "start": pose((-1690, 0, -600), (0, 0, 0)), "staging": pose((-1170, 0, -600), (0, 0, 0)),
                "target": pose((-990, 0, -600), (0, 0, 0)),
            },
            "photo": {"stand_off": '"700 mm"', "look_down": '"44 deg"'},
            "board": {"place_from_board": pose((-80, 330, 140), (-135, 0, -90))},
        },
    ),
    "a surface that is moved, turned and leans": (4,
        {},
        {**FAST, "surface": {"place_from_surface": pose((20, -30, 12), (0, 3, 25))}},
    ),
}  # fmt: skip
"""By what is otherwise: the world's seed, the configuration and the job."""


@pytest.mark.campaign
@pytest.mark.parametrize("name", CELLS)
def test_a_cell_that_is_described_otherwise_is_calibrated_and_places(name: str, tmp_path):
    seed, config, job = CELLS[name]
    cell, own = described(tmp_path, config, job)
    write_saddle(tmp_path / "saddle.ply")
    with Cell.open(cell, sim="all", clock="virtual", seed=seed, job=own) as opened:
        require_placed(opened.run(own).report)
