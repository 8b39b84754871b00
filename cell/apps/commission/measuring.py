"""The moves by which a camera's mounting and its board's size are measured: shifts first, then turns about the board.

Every way is a few millimetres or degrees, reckoned from what the view before has shown.

How a camera sits on the flange, and how large the board before it is, from a few views: pure geometry.

The arm is the measure of length. Shifts of the flange by known ways show how the camera's axes lie on it, and how long
the board's picture takes these ways to be: a wrong pitch makes all ways wrong alike, a wrong focal length only those
along the optical axis. Turns of the flange then show where the camera sits. No drawn value is believed here."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.apps.commission.check import Result
from cell.apps.commission.workplace import CommissionWorkplace, Eye, SeenBoard, find_view, see
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import from_parts, mean
from cell.measure.vision.board.view import centre_of
from drivers.errors import CellError, DeviceFault, RefusedError

LEAST_SHIFT_SHARE = 0.2
"""The shortest of three directions in which the flange was shifted, in shares of the longest."""
SNAP_RAD, SNAP_M = math.radians(8.0), 0.020
"""A mounting that is this near to a drawn one is that one: rough views tell no more, and calibration does."""


@dataclass(frozen=True, eq=False)
class Axes:
    """How the camera's axes lie on the flange, `flange_from_camera` (3, 3), and the true length of a millimetre as the
    pictures have it: `across` and `along` the optical axis."""

    flange_from_camera: Array
    across: float
    along: float


@dataclass(frozen=True, eq=False)
class RoughMounting:
    """A camera on the flange and the board before it, with `scale`, how much larger the board is than its name says.

    `residual` (m, RMS) is how far apart the views put the board.
    """

    flange_from_camera: pin.SE3
    base_from_board: pin.SE3
    scale: float
    residual: float


def axes_from_shifts(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> Axes:
    """From views with the flange's pose in the base, its orientation the same, and the board's pose in the camera.

    A shift d of the flange shifts the board by −Rᵀ d / scale in the camera. Raises `RefusedError` when the shifts do
    not go three ways.
    """
    turn = flanges[0].rotation.T
    moved = np.array([turn @ (f.translation - flanges[0].translation) for f in flanges[1:]])
    seen = np.array([b.translation - boards[0].translation for b in boards[1:]])
    sizes = np.linalg.svd(moved, compute_uv=False) if len(moved) else np.zeros(3)
    if len(sizes) < 3 or sizes[2] < LEAST_SHIFT_SHARE * sizes[0]:
        raise RefusedError(
            f"{len(flanges)} views do not show shifts along three axes: the board was lost from the picture. Give it "
            "more light, or put it where the camera sees it from further off"
        )
    camera_from_flange = -np.linalg.lstsq(moved, seen, rcond=None)[0].T
    lengths = np.linalg.norm(camera_from_flange, axis=1)
    u, _, vt = np.linalg.svd(camera_from_flange / lengths[:, None])
    if np.linalg.det(u @ vt) < 0:
        raise RefusedError(
            "the pictures are mirrored: shifts of the flange show the board going the other way along one axis only. "
            "Switch the camera's mirroring off (ReverseX, ReverseY), and see that no mirror is in its way"
        )
    return Axes((u @ vt).T, float(2.0 / (lengths[0] + lengths[1])), float(1.0 / lengths[2]))


def solve_mounting(
    flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3], rotation: Array, scale: float
) -> RoughMounting:
    """Where a camera sits whose axes lie as `rotation` (3, 3), from views with turns of a few degrees about two axes.

    One linear system for the camera's place on the flange and the board's in the base, `scale` being known.
    """
    rows = np.concatenate([np.column_stack([f.rotation, -np.eye(3)]) for f in flanges])
    told = [
        -f.translation - scale * f.rotation @ rotation @ b.translation for f, b in zip(flanges, boards, strict=True)
    ]
    found, *_ = np.linalg.lstsq(rows, np.concatenate(told), rcond=None)
    residual = (rows @ found - np.concatenate(told)).reshape(-1, 3)
    hand = from_parts(found[:3], rotation)
    placed = [
        flange * hand * from_parts(scale * board.translation, board.rotation)
        for flange, board in zip(flanges, boards, strict=True)
    ]
    return RoughMounting(hand, mean(placed), scale, float(np.sqrt((residual**2).sum(axis=1).mean())))


@dataclass(frozen=True, eq=False)
class Turned:
    """What of a drawn mounting is not so: `words` say how it is turned or where it is, `pose` is what would be right.

    `words` is empty where it is as drawn.
    """

    words: str
    pose: pin.SE3


def against_drawing(found: pin.SE3, drawn: pin.SE3, carriage: tuple[float, float] = (0.0, 0.0)) -> Turned:
    """A measured flange_from_camera beside the drawn one: as drawn, turned by right angles, or elsewhere.

    Where right angles explain it, the drawn numbers are kept and only turned. The camera may have been carried along
    its own x axis, by a way (m) within `carriage`, from where it is drawn: a rail that nobody has homed yet.
    """
    apart = float(np.linalg.norm(pin.log3(drawn.rotation.T @ found.rotation)))
    if _near(found, drawn, carriage):
        return Turned("", drawn)
    if apart < SNAP_RAD:
        away = _away(found, drawn, carriage)
        return Turned(
            f"it sits {1e3 * np.linalg.norm(away):.0f} mm from where it is drawn",
            from_parts(drawn.translation + away, drawn.rotation),
        )
    # The camera turned in its place; then the whole bracket, on other holes of the flange.
    for turn in _right_angles():
        here = from_parts(drawn.translation, drawn.rotation @ turn)
        if _near(found, here, carriage):
            return Turned(_in_words(turn), here)
    for quarters in (1, 2, 3):
        bracket = from_parts(np.zeros(3), pin.exp3(np.array([0.0, 0.0, 0.5 * math.pi * quarters]))) * drawn
        if _near(found, bracket, carriage):
            return Turned(f"its mounting is turned by {_signed(quarters)} deg about the flange's axis", bracket)
    return Turned(f"it is turned by {math.degrees(apart):.0f} deg against the drawing", found)


def _near(found: pin.SE3, other: pin.SE3, carriage: tuple[float, float]) -> bool:
    turned = np.linalg.norm(pin.log3(other.rotation.T @ found.rotation))
    return bool(turned < SNAP_RAD and np.linalg.norm(_away(found, other, carriage)) < SNAP_M)


def _away(found: pin.SE3, other: pin.SE3, carriage: tuple[float, float]) -> Array:
    """How far (3,), in the flange, the camera is from `other` when the carriage stands where that is least."""
    way = found.translation - other.translation
    ridden = min(max(float(way @ other.rotation[:, 0]), carriage[0]), carriage[1])
    return np.asarray(way - ridden * other.rotation[:, 0])


def _right_angles() -> list[Array]:
    """The 23 turns by right angles, those about the optical axis first."""
    made = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0.0 and not np.allclose(turn, np.eye(3)):
                made.append(turn)
    return sorted(made, key=lambda turn: -turn[2, 2])


def _in_words(turn: Array) -> str:
    if turn[2, 2] > 0.5:
        quarters = round(math.atan2(turn[1, 0], turn[0, 0]) / (0.5 * math.pi)) % 4
        if quarters == 2:
            return "the camera is upside down: turned by 180 deg about its optical axis"
        return f"its mounting is turned by {_signed(quarters)} deg about the optical axis"
    axis = np.asarray(pin.log3(turn))
    return (
        f"its mounting is turned by {math.degrees(np.linalg.norm(axis)):.0f} deg about "
        f"({', '.join(f'{v:.2f}' for v in axis / np.linalg.norm(axis))}) of the camera's axes"
    )


def _signed(quarters: int) -> int:
    return {1: 90, 2: 180, 3: -90}[quarters]


SMALL_TURN, TURN = math.radians(5.0), math.radians(12.0)
LEAST_TURNED = 4
"""Views with turns that a mounting is solved from, besides those with shifts."""


def measure(desk: CommissionWorkplace, result: Result, eye: Eye) -> tuple[Axes, RoughMounting]:
    """How the camera's axes lie on the flange, then where it sits, and how large the board is by the arm's measure.

    Raises `RefusedError` when the board is lost, or the views do not agree on one mounting.
    """
    first = find_view(desk, result, eye)
    desk.keep(result, f"{eye.name}-board", first.frame, first.view.pixels)
    shifts = [from_parts(sign * eye.step * np.eye(3)[axis]) for axis in (0, 1, 2) for sign in (1.0, -1.0)]
    shifted = _views(desk, eye, [first.base_from_flange * shift for shift in shifts])
    axes = _axes([first, *shifted])
    # Nothing is known yet of where the camera sits: small turns first, then larger ones about the board.
    hand = from_parts(eye.config.flange_from_camera.se3().translation, axes.flange_from_camera)
    seen = [first, *shifted]
    for turn in (SMALL_TURN, TURN):
        seen += _views(desk, eye, _turned(eye, first, hand, axes.across, turn))
        found = _solved(seen, axes)
        hand = found.flange_from_camera
    if len(seen) < 1 + len(shifted) + LEAST_TURNED:
        raise RefusedError(
            f"only {len(seen) - 1 - len(shifted)} of 12 turned views show the board, at least {LEAST_TURNED} are "
            "needed: see that light and lens let the camera see it from the side as well"
        )
    desk.last_views[eye.name] = first.base_from_flange
    return axes, found


def _views(desk: CommissionWorkplace, eye: Eye, goals: Iterable[pin.SE3]) -> list[SeenBoard]:
    """What is seen from these places; those that cannot be reached, or do not show the board, are left out."""
    mover = desk.mover()
    made = []
    for goal in goals:
        desk.look_around()
        try:
            mover.to(goal, f"{eye.name} before its board")
            made.append(see(desk, eye))
        except DeviceFault:
            raise
        except CellError:
            continue
    return made


def _axes(seen: Sequence[SeenBoard]) -> Axes:
    return axes_from_shifts([one.base_from_flange for one in seen], [one.camera_from_board for one in seen])


def _turned(eye: Eye, first: SeenBoard, hand: pin.SE3, scale: float, turn: float) -> list[pin.SE3]:
    """base_from_flange that look at the middle of the board from the first view, turned about each of its axes.

    `hand` is flange_from_camera as far as it is known, `scale` the board's.
    """
    at = first.camera_from_board
    centre = at.rotation @ centre_of(eye.board) * scale + scale * at.translation
    depth = float(np.linalg.norm(centre))
    base_from_camera = first.base_from_flange * hand
    middle = base_from_camera * from_parts(centre)
    made = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            rotation = pin.exp3(sign * turn * np.eye(3)[axis])
            made.append(middle * from_parts(np.zeros(3), rotation) * from_parts((0.0, 0.0, -depth)) * hand.inverse())
    return made


def _solved(seen: Sequence[SeenBoard], axes: Axes) -> RoughMounting:
    return solve_mounting(
        [one.base_from_flange for one in seen],
        [one.camera_from_board for one in seen],
        axes.flange_from_camera,
        axes.across,
    )
