"""The moves by which a camera's mounting and its board's size are measured: shifts first, then turns about the board.

Every way is a few millimetres or degrees, reckoned from what the view before has shown.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import pinocchio as pin

from cell.apps.commission.check import Result
from cell.apps.commission.mounting import Axes, RoughMounting, axes_from_shifts, solve_mounting
from cell.apps.commission.seeing import Eye, SeenBoard, find_view, see
from cell.apps.commission.workplace import CommissionWorkplace
from cell.measure.geometry.poses import from_parts
from cell.measure.vision.board.spec import centre_of
from drivers.errors import CellError, DeviceFault, RefusedError

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
