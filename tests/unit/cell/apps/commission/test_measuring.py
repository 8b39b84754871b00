"""What `cell commission` measures by, against closed forms: mountings and board sizes."""

import math
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cell.apps.commission.measuring import against_drawing, axes_from_shifts, solve_mounting
from cell.measure.geometry.poses import from_parts
from drivers.errors import RefusedError

DRAWN = from_parts((0.09, -0.05, 0.08), pin.rpy.rpyToMatrix(0.0, 0.0, math.radians(90.0)))


def turned(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    return np.asarray(pin.exp3(math.radians(degrees) * np.array(axis)))


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
def test_shifts_show_the_axes_and_the_board_and_turns_the_place(degrees: float):
    hand = DRAWN * from_parts((0.012, -0.007, 0.004), turned((0.0, 0.0, 1.0), degrees))
    flanges, boards = views(hand, pitch=1.25)
    axes = axes_from_shifts(flanges[:7], boards[:7])
    assert axes.flange_from_camera == pytest.approx(hand.rotation, abs=1e-9)
    assert (axes.across, axes.along) == pytest.approx((1.25, 1.25))
    found = solve_mounting(flanges, boards, axes.flange_from_camera, axes.across)
    assert found.flange_from_camera.translation == pytest.approx(hand.translation, abs=1e-9)
    assert found.base_from_board.translation == pytest.approx([-0.55, 0.25, 0.02], abs=1e-9)
    assert found.residual < 1e-9


def test_a_wrong_lens_is_told_from_a_wrong_board():
    flanges, boards = views(DRAWN, pitch=1.0, focal=1.5)
    axes = axes_from_shifts(flanges[:7], boards[:7])
    assert (axes.across, axes.along) == (pytest.approx(1.0), pytest.approx(1.0 / 1.5))


def test_a_mirrored_picture_and_shifts_along_two_axes_are_refused():
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
def test_a_mounting_that_is_not_as_drawn_is_told_in_words_and_the_right_one_given(change: Any, words: str):
    really = change(DRAWN)
    told, right = against_drawing(really, DRAWN)
    assert (words in told) if words else (told == "")
    assert against_drawing(really, right)[0] == ""


def test_where_a_rail_that_is_not_homed_carries_the_camera_is_no_fault_of_its_mounting():
    along = DRAWN * from_parts((0.07, 0.0, 0.0))
    assert "70 mm" in against_drawing(along, DRAWN)[0]
    assert against_drawing(along, DRAWN, (0.0, 0.1))[0] == ""
    assert "50 mm" in against_drawing(DRAWN * from_parts((0.07, 0.05, 0.0)), DRAWN, (0.0, 0.1))[0]
    head = DRAWN * from_parts(np.zeros(3), turned((0.0, 0.0, 1.0), 90.0)) * from_parts((0.07, 0.0, 0.0))
    assert "90 deg about the optical" in against_drawing(head, DRAWN, (0.0, 0.1))[0]
