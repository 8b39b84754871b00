"""Collecting what a calibration is solved from: the cell moves through its own poses over the boards on its deck.

Where a planned view misses the board, it is aimed anew by what the other views showed, or searched for.
"""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import CellConfig
from cell.devices.devices import Devices
from cell.measure.calibration import ScanObservation, TargetObservation
from cell.measure.calibration.solve.starts import solve_hand_eye
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.poses import from_parts, from_ur, mean
from cell.measure.vision.board.board import board_pose, find_board
from cell.measure.vision.board.view import BoardSpec, BoardView, parse_board
from cell.measure.vision.stripe.extract import extract
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover, moved_once_more
from cell.procedures.arm.photograph import CalibrationView, scan_calibration_views, target_calibration_views
from cell.procedures.sweep.sweeping import home_rail
from drivers.errors import RefusedError
from drivers.interfaces import Camera, Frame

SEARCH_M = 0.009
"""Step of the search around a planned view, m: a fifth of what the camera sees from there."""
LEAST_VIEWS = 5
"""Views from which on hand-eye and board are solved for together."""
BELIEVED_M = 0.03
"""A solution that puts the board farther than this from the drawing is not believed."""


class Aim:
    """Learns from the views that were found where the scan camera and the fine board are, roughly."""

    def __init__(self, config: CellConfig, camera: CameraModel) -> None:
        """`camera` is the nominal one."""
        self._camera = camera
        self._drawn_hand = config.scan_camera.flange_from_camera.se3()
        self._drawn_board = config.calibration.fine.base_from_board.se3()
        self._flanges: list[pin.SE3] = []
        self._boards: list[pin.SE3] = []
        self._rails: list[float] = []

    def learn(self, seen: BoardView, base_from_flange: pin.SE3, rail: float) -> None:
        """Note a view that was found; one whose pose is ambiguous tells nothing."""
        with suppress(RefusedError):
            self._boards.append(board_pose(seen, self._camera).camera_from_board)
            self._flanges.append(base_from_flange)
            self._rails.append(rail)

    def instead_of(self, view: CalibrationView) -> list[CalibrationView]:
        """Views to try, in this order, when `view` does not show the board."""
        along = from_parts((view.rail_position, 0.0, 0.0))
        base_from_camera = view.base_from_flange * self._drawn_hand * along
        if self._boards:
            hand, board, direction = self._learned()
            camera_from_board = base_from_camera.inverse() * self._drawn_board
            flange_from_camera = hand * from_parts(view.rail_position * direction)
            aimed = board * camera_from_board.inverse() * flange_from_camera.inverse()
            return [CalibrationView(aimed, view.rail_position)]
        flange_from_camera = self._drawn_hand * along
        shifts = [np.array([x, y, 0.0]) for x in (0.0, 1.0, -1.0) for y in (0.0, 1.0, -1.0) if x or y]
        return [
            CalibrationView(
                base_from_camera * from_parts(SEARCH_M * shift) * flange_from_camera.inverse(), view.rail_position
            )
            for shift in shifts
        ]

    def _learned(self) -> tuple[pin.SE3, pin.SE3, np.ndarray]:
        """flange_from_camera at rail zero, base_from_board, and the rail's direction."""
        along = np.array([1.0, 0.0, 0.0])
        if len(self._boards) >= LEAST_VIEWS:
            with suppress(RefusedError, np.linalg.LinAlgError):
                found = solve_hand_eye(self._flanges, self._boards, self._rails, along)
                off = found.base_from_board.translation - self._drawn_board.translation
                if np.linalg.norm(off) < BELIEVED_M:
                    return found.flange_from_camera, found.base_from_board, found.rail_direction
        # With the board where it is drawn, the hand-eye takes up what both are off: right for views that are like
        # those that were seen, roughly right for others.
        hands = [
            flange.inverse() * self._drawn_board * board.inverse() * from_parts(-rail * along)
            for flange, board, rail in zip(self._flanges, self._boards, self._rails, strict=True)
        ]
        return mean(hands), self._drawn_board, along


PHOTO_RATE = 10.0
LEAST_SHARE = 0.75
"""Share of the planned views that have to show the board."""

RAIL_MOVE_VIEWS, RAIL_MOVE = (6, 10, 14), 0.015
"""Views, with the rail near its middle, at which it moves by this much (m) either way while the arm rests."""

Progress = Callable[[float, str], None]
Check = Callable[[], None]
Keep = Callable[[str, Frame], None]
"""Takes what a picture shows, and the picture: what a refusal was about can then be looked at."""
Made = TypeVar("Made")


def collect_scan(
    config: CellConfig, devices: Devices, mover: Mover, check: Check, progress: Progress, keep: Keep
) -> list[ScanObservation]:
    """Dots and stripe on the fine board, at several depths, tilts and rail positions; every picture goes to `keep`.

    The laser is off for a photograph and on for the stripe. At some views the rail moves either way for further
    photographs while the arm rests (`same_rest`), right after their view in the list. Raises `RefusedError` when too
    few views show the board.
    """
    board = parse_board(config.calibration.fine.board)
    views = scan_calibration_views(config, board)
    camera, rail = devices.scan_camera, devices.rail
    home_rail(devices, progress)
    mover.to_joints(HOME)
    aim = Aim(config, nominal_camera(config.scan_camera))
    made: list[ScanObservation] = []
    moved: list[ScanObservation] = []
    refusals = Counter[str]()
    for k, view in enumerate(views):
        check()
        progress(k / len(views), f"fine board, view {k + 1} of {len(views)}")
        mover.hold()
        travel = rail.move_to(view.rail_position)
        move_to_view(devices, mover, view, k)
        travel.wait(30.0)
        camera.configure(config.scan_camera.photo_exposure, PHOTO_RATE)
        what = f"fine-{k + 1:02d}"
        seen = look_for(camera, board, refusals, keep, what)
        for other in aim.instead_of(view) if seen is None else ():
            check()
            progress(k / len(views), f"fine board, view {k + 1} of {len(views)}, aimed anew")
            # It was not planned: out of reach, or not to be reached without touching something, it is left out.
            with suppress(RefusedError):
                move_to_view(devices, mover, other, k)
                seen = look_for(camera, board, refusals, keep, f"{what}-again")
            if seen is not None:
                break
        if seen is None:
            continue
        aim.learn(seen, from_ur(devices.arm.state().flange), rail.state().position)
        camera.configure(config.calibration.stripe_exposure, PHOTO_RATE)
        with devices.interlocks.purpose("calibration"), devices.laser.lit():
            lit = camera.grab()
        keep(f"{what}-stripe", lit)
        stripe = extract(lit.image)
        base_from_flange = from_ur(devices.arm.state().flange)
        made.append(ScanObservation(seen, stripe, base_from_flange, rail.state().position, f"fine {k + 1}"))
        if k in RAIL_MOVE_VIEWS:
            camera.configure(config.scan_camera.photo_exposure, PHOTO_RATE)
            moved.extend(_rail_moves(config, devices, board, made[-1], keep))
    _enough(made, views, refusals)
    return [o for view in made for o in (view, *(m for m in moved if m.name.startswith(view.name + " ")))]


def _rail_moves(
    config: CellConfig, devices: Devices, board: BoardSpec, here: ScanObservation, keep: Keep
) -> list[ScanObservation]:
    """Photographs of the fine board with the rail moved either way and the arm where it is; those that show it."""
    made = []
    low, high = config.rail.travel
    for way in (-RAIL_MOVE, RAIL_MOVE):
        devices.rail.move_to(min(max(here.rail_position + way, low), high)).wait(30.0)
        name = f"{here.name} {'+' if way > 0 else '-'}"
        seen = look_for(devices.scan_camera, board, Counter(), keep, name.replace(" ", "-"))
        if seen is not None:
            rail = devices.rail.state().position
            made.append(ScanObservation(seen, None, here.base_from_flange, rail, name, same_rest=True))
    return made


def collect_target(
    config: CellConfig, devices: Devices, mover: Mover, check: Check, progress: Progress, keep: Keep
) -> list[TargetObservation]:
    """Dots of the large board, at several distances and tilts; every picture goes to `keep`. Raises `RefusedError` when
    too few views show it."""
    board = parse_board(config.calibration.large.board)
    views = target_calibration_views(config, board)
    devices.target_camera.configure(config.target_camera.photo_exposure, PHOTO_RATE)
    made: list[TargetObservation] = []
    refusals = Counter[str]()
    for k, view in enumerate(views):
        check()
        progress(k / len(views), f"large board, view {k + 1} of {len(views)}")
        move_to_view(devices, mover, view, k)
        seen = look_for(devices.target_camera, board, refusals, keep, f"large-{k + 1:02d}")
        if seen is not None:
            made.append(TargetObservation(seen, from_ur(devices.arm.state().flange), f"large {k + 1}"))
    return _enough(made, views, refusals)


def move_to_view(devices: Devices, mover: Mover, view: CalibrationView, k: int) -> None:
    """To a view; after a stop that a program may clear, once more."""
    moved_once_more(devices.arm, lambda: mover.to(view.base_from_flange, f"calibration view {k + 1}"))


def look_for(camera: Camera, board: BoardSpec, refusals: Counter[str], keep: Keep, what: str) -> BoardView | None:
    """The board in a new picture of `what`; None when it is refused, with the reason counted."""
    frame = camera.grab()
    try:
        seen = find_board(frame.image, board)
    except RefusedError as error:
        refusals[str(error)] += 1
        keep(f"{what}-refused", frame)
        return None
    keep(what, frame)
    return seen


def _enough(made: list[Made], views: list[CalibrationView], refusals: Counter[str]) -> list[Made]:
    if len(made) < LEAST_SHARE * len(views):
        raise RefusedError(
            f"only {len(made)} of {len(views)} calibration views show the board; check its place, the light and the "
            "lens: " + "; ".join(f"{count} times: {reason}" for reason, count in refusals.most_common())
        )
    return made
