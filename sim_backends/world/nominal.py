"""The nominal geometry of the simulated cell: where everything would be if nothing deviated.

Frames: world W (z up, floor z = 0), vehicle V, arm base B, flange F (z out of the flange), scan camera C, target
camera T (z along the optical axis), part, surface S, place frame P, boards D (x right, y down, z into the board).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Pose = NDArray[np.float64]


def pose(translation: Sequence[float], x_axis: Sequence[float], z_axis: Sequence[float]) -> Pose:
    """The (4, 4) transformation with this translation, m, and these (exact, orthonormal) x and z axes."""
    x, z = np.array(x_axis, dtype=float), np.array(z_axis, dtype=float)
    made = np.eye(4)
    made[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    made[:3, 3] = translation
    return made


def inverse(a_from_b: Pose) -> Pose:
    """`b_from_a` (4, 4) of a rigid transformation."""
    made = np.eye(4)
    made[:3, :3] = a_from_b[:3, :3].T
    made[:3, 3] = -made[:3, :3] @ a_from_b[:3, 3]
    return made


def board_pose(
    centre: Sequence[float], x_axis: Sequence[float], z_axis: Sequence[float], size: Sequence[float]
) -> Pose:
    """The pose of a board whose lattice of `size` (m) is centred at `centre`; its origin is the lattice's corner."""
    made = pose(centre, x_axis, z_axis)
    made[:3, 3] -= made[:3, 0] * size[0] / 2.0 + made[:3, 1] * size[1] / 2.0
    return made


LARGE_BOARD_SIZE = (0.160, 0.120)
"""From the first dot to the last of the station's board and of the deck's large board, m."""
_FINE_SIZE = (0.030, 0.024)
_C45 = math.sqrt(0.5)

TABLE_HEIGHT = 0.60
"""The table's top above the floor, m."""
TABLE_HALF = 0.25
"""The table reaches this far, m, along x and y around the surface's origin."""
WORLD_FROM_PLACE = pose((0.0, 0.0, TABLE_HEIGHT), (1, 0, 0), (0, 0, 1))
PLACE_FROM_BOARD = board_pose((0.10, 0.32, 0.12), (0, -1, 0), (_C45, 0, -_C45), LARGE_BOARD_SIZE)
WORLD_FROM_VEHICLE_START = pose((-3.05, 0.0, 0.0), (1, 0, 0), (0, 0, 1))
VEHICLE_FROM_BASE = pose((0.30, 0.0, 0.55), (1, 0, 0), (0, 0, 1))
BASE_FROM_FINE_BOARD = board_pose((-0.55, 0.25, 0.02), (1, 0, 0), (0, 0, -1), _FINE_SIZE)
BASE_FROM_DECK_BOARD = board_pose((-0.60, -0.25, 0.02), (1, 0, 0), (0, 0, -1), LARGE_BOARD_SIZE)

FLANGE_FROM_SCAN_CAMERA = pose((0.09, -0.05, 0.08), (0, 1, 0), (0, 0, 1))
"""The scan camera with the carriage at home."""
FLANGE_FROM_TARGET_CAMERA = pose((-0.10, 0.0, 0.03), (0, 1, 0), (0, 0, 1))
FLANGE_FROM_WITNESS = pose((0.09, -0.0625, 0.165), (0, 1, 0), (0, 0, 1))
"""A plate of `WITNESS_SIZE` on the claw: with the carriage at home the laser's line lies on it, beside the sweeps."""
WITNESS_SIZE = (0.013, 0.012)
FLANGE_FROM_PART = pose((0.0, 0.0, 0.17), (0, 1, 0), (0, 0, -1))
RAIL_DIRECTION = np.array([1.0, 0.0, 0.0])
"""The way the carriage moves, in C."""

FOCAL_LENGTH = 0.008
F_NUMBER = 4.0
PIXEL = 4.8e-6
SCAN_SIZE = (640, 480)
SCAN_FOCUS = 0.130
TARGET_SIZE = (1280, 1024)
TARGET_FOCUS = 1.0
LASER_BASELINE = 0.035
"""From the scan camera to the laser's exit point, against C's x axis, m."""
LASER_TAN_THETA = 3.5
"""Tangent of the angle at the laser between baseline and light plane."""

LASER_OUTPUT = 0
CLAW_OUTPUT = 1
GRIP_INPUT = 0
"""Standard digital outputs and input of the arm that switch the laser, close the claw and report its grip."""
