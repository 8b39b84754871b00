"""What `cell commission` measures by, against closed forms: mountings, board sizes, weights, stripes; and its files."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cell.apps.commission.check import CommissionCheck, Progress, Result
from cell.apps.commission.checks.rail import judge
from cell.apps.commission.measuring import against_drawing, axes_from_shifts, solve_mounting
from cell.apps.commission.sequence import CHECKS, edited, table, write_changes
from cell.config.cell_config import default_toml, load_config
from cell.config.job import load_job
from cell.measure.geometry.poses import from_parts
from drivers.errors import ConfigError, RefusedError
from drivers.make import CameraConfig
from sim_backends.clock import SteppedClock
from sim_backends.models.arm import ArmModel, ArmParams
from tests.support import ROOT

DRAWN = from_parts((0.09, -0.05, 0.08), pin.rpy.rpyToMatrix(0.0, 0.0, math.radians(90.0)))


def turned(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    return np.asarray(pin.exp3(math.radians(degrees) * np.array(axis)))


# --- mountings and boards ---


def views(hand: pin.SE3, pitch: float = 1.0, focal: float = 1.0, *, mirrored: bool = False) -> tuple[Any, Any]:
    """Flange poses, shifts and then turns, and the board as a camera on `hand` tells it, with a board that is `pitch`
    times as large as its name, and a lens whose focal length is drawn `focal` times as long as it is."""
    board = from_parts((-0.55, 0.25, 0.02), turned((1.0, 0.0, 0.0), 180.0))
    first = board * from_parts((0.015, 0.012, -0.13), turned((1.0, 0.3, 0.0), 12.0)) * hand.inverse()
    moves = [from_parts(s * 0.005 * axis) for axis in np.eye(3) for s in (1.0, -1.0)]
    moves += [from_parts(np.zeros(3), turned(axis, 8.0)) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 1, 0))]
    flanges = [first, *(first * move for move in moves)]
    boards = []
    for flange in flanges:
        seen = (flange * hand).inverse() * board
        at = seen.translation / pitch * np.array([-1.0 if mirrored else 1.0, 1.0, focal])
        boards.append(from_parts(at, seen.rotation))
    return flanges, boards


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, -90.0, 37.0])
def test_shifts_show_the_axes_and_the_board_and_turns_the_place(degrees: float) -> None:
    hand = DRAWN * from_parts((0.012, -0.007, 0.004), turned((0.0, 0.0, 1.0), degrees))
    flanges, boards = views(hand, pitch=1.25)
    axes = axes_from_shifts(flanges[:7], boards[:7])
    assert axes.flange_from_camera == pytest.approx(hand.rotation, abs=1e-9)
    assert (axes.across, axes.along) == pytest.approx((1.25, 1.25))
    found = solve_mounting(flanges, boards, axes.flange_from_camera, axes.across)
    assert found.flange_from_camera.translation == pytest.approx(hand.translation, abs=1e-9)
    assert found.base_from_board.translation == pytest.approx([-0.55, 0.25, 0.02], abs=1e-9)
    assert found.residual < 1e-9


def test_a_wrong_lens_is_told_from_a_wrong_board() -> None:
    flanges, boards = views(DRAWN, pitch=1.0, focal=1.5)
    axes = axes_from_shifts(flanges[:7], boards[:7])
    assert axes.across == pytest.approx(1.0)
    assert axes.along == pytest.approx(1.0 / 1.5)


def test_a_mirrored_picture_and_shifts_along_two_axes_are_refused() -> None:
    flanges, boards = views(DRAWN, mirrored=True)
    with pytest.raises(RefusedError, match="mirrored"):
        axes_from_shifts(flanges[:7], boards[:7])
    flanges, boards = views(DRAWN)
    with pytest.raises(RefusedError, match="three axes"):
        axes_from_shifts(flanges[:5], boards[:5])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: from_parts(p.translation + 0.01, p.rotation @ turned((1.0, 0.0, 0.0), 3.0)), ""),
        (lambda p: p * from_parts(np.zeros(3), turned((0.0, 0.0, 1.0), 180.0)), "upside down"),
        (lambda p: p * from_parts(np.zeros(3), turned((0.0, 0.0, 1.0), 90.0)), "turned by 90 deg about the optical"),
        (lambda p: p * from_parts(np.zeros(3), turned((0.0, 0.0, 1.0), -90.0)), "turned by -90 deg about the optical"),
        (lambda p: p * from_parts(np.zeros(3), turned((1.0, 0.0, 0.0), 90.0)), "turned by 90 deg about (1.00"),
        (lambda p: from_parts(np.zeros(3), turned((0.0, 0.0, 1.0), 90.0)) * p, "90 deg about the flange's axis"),
        (lambda p: from_parts(p.translation + np.array([0.0, 0.0, 0.05]), p.rotation), "50 mm from where"),
        (lambda p: p * from_parts(np.zeros(3), turned((0.0, 0.0, 1.0), 40.0)), "turned by 40 deg against"),
    ],
)  # fmt: skip
def test_a_mounting_that_is_not_as_drawn_is_told_in_words_and_the_right_one_given(change: Any, words: str) -> None:
    really = change(DRAWN)
    told = against_drawing(really, DRAWN)
    assert (words in told.words) if words else (told.words == "")
    right = against_drawing(really, told.pose)
    assert right.words == ""


def test_where_a_rail_that_is_not_homed_carries_the_camera_is_no_fault_of_its_mounting() -> None:
    along = DRAWN * from_parts((0.07, 0.0, 0.0))
    assert "70 mm" in against_drawing(along, DRAWN).words
    assert against_drawing(along, DRAWN, (0.0, 0.1)).words == ""
    assert "50 mm" in against_drawing(DRAWN * from_parts((0.07, 0.05, 0.0)), DRAWN, (0.0, 0.1)).words
    head = DRAWN * from_parts(np.zeros(3), turned((0.0, 0.0, 1.0), 90.0)) * from_parts((0.07, 0.0, 0.0))
    assert "90 deg about the optical" in against_drawing(head, DRAWN, (0.0, 0.1)).words


def judged(told: float, moved: tuple[float, float, float]) -> list[str]:
    result = Result()
    judge(load_config(None).rail, result, told, 1e-3 * np.array(moved))
    return [f"{finding.name} {finding.write}" for finding in result.findings]


def test_a_rail_is_judged_by_the_way_that_its_camera_went() -> None:
    assert judged(0.005, (4.97, 0.05, -0.1)) == []
    assert judged(-0.005, (-4.97, 0.05, -0.1)) == []
    assert judged(0.005, (-5.02, 0.1, 0.0)) == ["rail.reversed {'rail.reversed': 'true'}"]
    assert judged(0.005, (9.95, 0.1, 0.0)) == ["rail.lead {'rail.lead': '\"4 mm\"'}"]
    assert judged(-0.005, (1.26, 0.0, 0.0)) == [
        "rail.reversed {'rail.reversed': 'true'}", "rail.lead {'rail.lead': '\"0.5 mm\"'}",
    ]  # fmt: skip
    # Across its x axis it is no reversed rail, but a camera that is turned on the carriage.
    assert judged(0.005, (0.1, 5.0, 0.0)) == []
    with pytest.raises(RefusedError, match="coupling"):
        judged(0.005, (0.02, 0.01, 0.0))


# --- weight and light ---


def test_a_simulated_arm_feels_the_weight_that_it_was_not_told_of_and_takes_it_as_zero_when_asked() -> None:
    arm = ArmModel(ArmParams(carried=3.0, carried_centre=(0.0, 0.0, 0.1)), np.random.default_rng(1), SteppedClock())
    assert arm.felt == pytest.approx(np.zeros(6))
    arm.payload = (2.0, np.array([0.0, 0.0, 0.1]))
    flange = arm.reported_flange()[:3, :3]
    weight = np.array([0.0, 0.0, -9.81])
    assert arm.felt == pytest.approx([*weight, *np.cross(flange @ [0.0, 0.0, 0.1], weight)], abs=1e-9)
    arm.zero_force()
    assert arm.felt == pytest.approx(np.zeros(6))


# --- files ---

AT = '["9 mm", "-5 mm", "8 mm"]'
CHANGES = {
    "rail.lead": '"4 mm"',
    "rail.reversed": "true",
    "laser.output": "1",
    "claw.output": "0",
    "calibration.fine.board": '"marked_dots:11x9:2.5mm"',
    "arm.payload": '"4.3 kg"',
    "arm.payload_centre": '["0 mm", "1 mm", "60 mm"]',
    "scan_camera.flange_from_camera": f"{{ translation = {AT}, rotation = {AT.replace('mm', 'deg')} }}",
}  # fmt: skip


def test_values_are_changed_and_everything_else_of_the_file_stays() -> None:
    text = default_toml()
    new = edited(text, CHANGES)
    wanted = tomllib.loads(text)
    for key, value in CHANGES.items():
        *tables, name = key.split(".")
        table: Any = wanted
        for part in tables:
            table = table[part]
        table[name] = tomllib.loads(f"x = {value}")["x"]
    assert tomllib.loads(new) == wanted
    assert re.findall(r"#.*", new) == re.findall(r"#.*", text)
    assert len(new.splitlines()) == len(text.splitlines())


def test_a_value_over_several_lines_and_a_key_that_is_missing_are_written_too() -> None:
    text = '[a]  # first\nlist = [\n  1,  # one\n  2,\n]\nb = "x # y"   # said\n\n[c.d]\ne = 1\n'
    new = edited(text, {"a.list": "[3]", "a.b": '"z"', "c.d.f": "2", "g.h": "true"})
    assert tomllib.loads(new) == {"a": {"list": [3], "b": "z"}, "c": {"d": {"e": 1, "f": 2}}, "g": {"h": True}}
    assert "# said" in new and "# first" in new


def test_what_cannot_be_changed_without_risk_is_refused_with_what_to_write(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"a\.b = 2"):
        edited("a = 1\n", {"a.b": "2"})
    monkeypatch.setattr("tomlkit.value", lambda value: 3)
    with pytest.raises(ConfigError, match=r"a\.b = 2"):
        edited("[a]\nb = 1\n", {"a.b": "2"})


def test_the_old_file_is_kept_each_time(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(default_toml(), encoding="utf-8")
    kept = [write_changes(path, {"rail.lead": f'"{k} mm"'}) for k in (3, 4)]
    assert len(set(kept)) == 2
    assert kept[0].read_text(encoding="utf-8") == default_toml()
    assert 'lead = "3 mm"' in kept[1].read_text(encoding="utf-8")
    assert load_config(path).rail.lead == pytest.approx(0.004)


def test_a_changed_configuration_makes_stale_what_rests_on_it_and_no_more(tmp_path: Path) -> None:
    job, _ = load_job("pot")
    progress, config = Progress(tmp_path, {"name": "x"}, job), load_config(None)
    for check in CHECKS:
        progress.keep(check, config, Result(), 1.0, "")
    again = Progress(tmp_path, {"name": "x"}, job)
    assert {again.standing(check, config) for check in CHECKS} == {"good"}
    wider = config.model_copy(update={"scan_camera": changed(config.scan_camera)})
    stale = {check.name for check in CHECKS if again.standing(check, wider) == "stale"}
    assert {"scan_picture", "scan_mounting", "rail_direction", "outputs", "calibration"} <= stale
    assert not {"links", "arm_axes", "payload", "target_picture", "target_mounting"} & stale
    other = Progress(tmp_path, {"name": "y"}, job)
    assert {other.standing(check, config) for check in CHECKS} == {"stale"}


def changed(camera: CameraConfig) -> CameraConfig:
    return camera.model_copy(update={"focal_length": 0.012})


def test_every_check_says_what_moves_and_needs_only_earlier_ones() -> None:
    before: set[str] = set()
    for check in CHECKS:
        assert isinstance(check, CommissionCheck)
        assert check.title and check.limit and check.moves
        assert check.moves == "nothing" or (check.far and check.fast)
        assert set(check.needs) <= before, check.name
        before.add(check.name)


def test_the_documents_table_is_current() -> None:
    text = (ROOT / "docs" / "how-to" / "commission.md").read_text(encoding="utf-8")
    assert table() in text
