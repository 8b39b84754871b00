"""What the numbers of a pose may mean: quaternions in both orders, rotation vectors, Euler angles, matrices.

Nothing is chosen here: `decide.py` asks the pictures which reading they agree with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pinocchio as pin
import scipy

from cell.geometry.camera import Array
from cell.geometry.poses import from_matrix, from_parts, from_quaternion
from drivers.errors import ConfigError

# Matrices are written with few digits at times.
ORTHOGONAL_OFF = 0.02


@dataclass(frozen=True)
class Reading:
    """A meaning of `count` numbers: `name` for --poses, `text` for people, `pose` from numbers, lengths as they are."""

    name: str
    count: int
    text: str
    pose: Callable[[Array], pin.SE3]


def _quaternion(numbers: Array, first: bool, wxyz: bool) -> pin.SE3:
    turn, place = (numbers[:4], numbers[4:]) if first else (numbers[3:], numbers[:3])
    return from_quaternion(place, turn[[1, 2, 3, 0]] if wxyz else turn)


def _angles(numbers: Array, first: bool, kind: str, degrees: bool) -> pin.SE3:
    turn, place = (numbers[:3], numbers[3:]) if first else (numbers[3:], numbers[:3])
    if kind == "rotvec":
        rotation = scipy.spatial.transform.Rotation.from_rotvec(turn, degrees=degrees)
    else:
        rotation = scipy.spatial.transform.Rotation.from_euler(kind, turn, degrees=degrees)
    return from_parts(place, rotation.as_matrix())


def _nine(numbers: Array, first: bool, transposed: bool) -> pin.SE3:
    turn, place = (numbers[:9], numbers[9:]) if first else (numbers[3:], numbers[:3])
    matrix = turn.reshape(3, 3).T if transposed else turn.reshape(3, 3)
    return _rigid(matrix, place)


def _matrix(numbers: Array, columns: bool) -> pin.SE3:
    rows = len(numbers) // 4
    matrix = numbers.reshape(4, rows).T if columns else numbers.reshape(rows, 4)
    # Some write zeros where the last 1 belongs.
    if rows == 4 and (np.abs(matrix[3, :3]).max() > 1e-6 or min(abs(matrix[3, 3] - 1), abs(matrix[3, 3])) > 1e-6):
        raise ValueError(f"its last row is {matrix[3].tolist()}, not 0 0 0 1")
    return _rigid(matrix[:3, :3], matrix[:3, 3])


def _rigid(rotation: Array, place: Array) -> pin.SE3:
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ORTHOGONAL_OFF:
        raise ValueError(f"its 3×3 is no rotation: {np.round(rotation, 4).tolist()}")
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation, place
    return from_matrix(whole)


def _readings() -> dict[str, Reading]:
    found: list[Reading] = []
    for first in (False, True):
        place = "{}+xyz" if first else "xyz+{}"
        for order in ("xyzw", "wxyz"):
            pose = partial(_quaternion, first=first, wxyz=order == "wxyz")
            found.append(Reading(place.format(f"quaternion-{order}"), 7, f"quaternion {order}", pose))
        for kind, name, text in (
            ("rotvec", "rotvec", "rotation vector"),
            ("xyz", "rpy", "roll, pitch, yaw about fixed x, y, z"),
            ("XYZ", "euler-xyz", "Euler angles about x, then the new y, then the new z"),
            ("ZYX", "abc", "angles A, B, C about z, then the new y, then the new x"),
            ("ZYZ", "euler-zyz", "Euler angles about z, then the new y, then the new z"),
            ("ZXZ", "euler-zxz", "Euler angles about z, then the new x, then the new z"),
            ("zyx", "ypr", "yaw, pitch, roll about fixed z, y, x"),
        ):
            for unit in ("rad", "deg"):
                pose = partial(_angles, first=first, kind=kind, degrees=unit == "deg")
                found.append(Reading(place.format(f"{name}-{unit}"), 6, f"{text}, in {unit}", pose))
        for by, text in (("", "rows"), ("-by-columns", "columns")):
            pose = partial(_nine, first=first, transposed=bool(by))
            found.append(Reading(place.format(f"rotation-9{by}"), 12, f"3×3 rotation by {text}", pose))
    for rows in (3, 4):
        for by, text in (("", "rows"), ("-by-columns", "columns")):
            pose = partial(_matrix, columns=bool(by))
            found.append(Reading(f"matrix-{rows}x4{by}", 4 * rows, f"{rows}×4 matrix by {text}", pose))
    return {r.name: r for r in found}


READINGS = _readings()


def readings_of(count: int, named: str, wanted: str | None) -> list[Reading]:
    """The readings of so many numbers, those that the names beside them allow, or the one that was asked for.

    `named` is a record's: "quaternion" or "rotation" (position first), or empty.
    """
    if wanted is not None:
        return [READINGS[wanted]] if READINGS[wanted].count == count else []
    if named == "quaternion":
        return [READINGS["xyz+quaternion-xyzw"]]
    return [r for r in READINGS.values() if r.count == count and not (named and not r.name.startswith("xyz+"))]


def check_reading(name: str | None) -> None:
    """ConfigError for a name that --poses does not know."""
    if name is not None and name not in READINGS:
        raise ConfigError(f"--poses {name}: unknown, allowed are {', '.join(READINGS)}")


def why_not(record_numbers: Array, named: str, wanted: str | None) -> str:
    """Why no reading makes a pose of these numbers."""
    if not np.isfinite(record_numbers).all():
        return "it holds values that are not finite"
    errors = []
    for reading in readings_of(len(record_numbers), named, wanted):
        try:
            reading.pose(record_numbers)
        except ValueError as error:
            errors.append(str(error))
    return errors[0] if errors else f"it holds {len(record_numbers)} numbers, which --poses {wanted} does not mean"
