"""What the configuration draws on flange and deck, as bodies: the scan head, the target camera, the boards."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from cell.config.cell_config import CellConfig
from cell.measure.geometry.poses import from_parts
from cell.measure.vision import parse_board
from cell.measure.vision.board.spec import centre_of
from cell.motion.bodies import Mounted

PLATE_THICKNESS = 0.01
"""Of a calibration board, m."""


def mounted(config: CellConfig) -> Mounted:
    """What the flange carries beside the claw, where the configuration has it."""
    scan, target = (camera.flange_from_camera.se3() for camera in (config.scan_camera, config.target_camera))
    return Mounted(scan, target, config.laser.baseline, config.rail.travel)


def deck_plates(config: CellConfig) -> list[tuple[str, pin.SE3, tuple[float, float, float]]]:
    """The calibration boards on the deck: name, base_from_centre and size, m."""
    plates = []
    for name, plate in (("fine plate", config.calibration.fine), ("large board", config.calibration.large)):
        board = parse_board(plate.board)
        width, height = np.ptp(board.points()[:, :2], axis=0) + 2 * board.pitch
        below = from_parts(centre_of(board) + np.array([0.0, 0.0, PLATE_THICKNESS / 2]))
        plates.append((name, plate.base_from_board.se3() * below, (width, height, PLATE_THICKNESS)))
    return plates
