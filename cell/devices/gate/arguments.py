"""What the arm is asked for, checked before the interlocks reckon with it: shape, finite numbers, widest ranges.

The make's own limits, which may be tighter, are its driver's.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import LimitError
from drivers.interfaces import Vector
from drivers.quantities import check_range

TURN_RAD = 2 * math.pi
"""No joint turns further than a full turn from zero."""
FAR_M = 3.0
"""No arm of this kind reaches further from its base."""


def checked_joints(device: str, joints: ArrayLike) -> Vector:
    """Joint angles (6,) in rad, else `LimitError`."""
    array = _numbers(device, "joint angles", joints)
    if array.shape != (6,):
        raise LimitError(device, f"joint angles must be 6 numbers, got shape {array.shape}; nothing was sent")
    return _turns(device, array)


def checked_way(device: str, joints: ArrayLike) -> Vector:
    """Joint angles (n, 6) in rad of at least one point, else `LimitError`."""
    array = _numbers(device, "a trajectory's joint angles", joints)
    if array.ndim != 2 or array.shape[1] != 6 or not len(array):
        raise LimitError(
            device, f"a trajectory needs joint angles (n, 6), n at least 1, got shape {array.shape}; nothing was sent"
        )
    return _turns(device, array)


def checked_pose(device: str, flange: ArrayLike) -> Vector:
    """The flange's pose (6,) in the base, m and rotation vector in rad, else `LimitError`."""
    array = _numbers(device, "flange pose", flange)
    if array.shape != (6,):
        raise LimitError(device, f"flange pose must be 6 numbers, got shape {array.shape}; nothing was sent")
    check_range(device, "distance of the flange from the base", float(np.linalg.norm(array[:3])), 0.0, FAR_M, unit="m")
    return array


def _numbers(device: str, what: str, values: ArrayLike) -> Vector:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise LimitError(device, f"{what} must be numbers; nothing was sent: {error}") from error
    if not np.isfinite(array).all():
        raise LimitError(device, f"{what} hold values that are not finite; nothing was sent")
    return array


def _turns(device: str, joints: Vector) -> Vector:
    for value in (joints.min(), joints.max()):
        check_range(device, "joint angle", float(value), low=-TURN_RAD, high=TURN_RAD, unit="rad")
    return joints
