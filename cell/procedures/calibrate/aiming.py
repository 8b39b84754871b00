"""Where the scan camera has to go when a planned calibration view misses the board.

Mounting and board may lie several mm from the drawing, more than a small board leaves room for. What the views so far
showed tells where both are; while there is none, the surroundings of the planned view are searched.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pinocchio as pin

from cell.config.cell_config import CellConfig
from cell.measure.calibration.solve.hand_eye import solve_hand_eye
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.poses import from_parts, mean
from cell.measure.vision import BoardView, board_pose
from cell.procedures.arm.camera_poses import CalibrationView
from drivers.errors import RefusedError

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
