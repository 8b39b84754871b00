"""What the numbers of a pose may mean: the table of conventions that are tried, and the names that --poses knows.

Nothing is chosen here: `agreement.py` asks the pictures which reading they agree with.
"""

import re
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from cell.apps.recordings.texts import COUNTS, ORTHOGONAL_OFF
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import from_matrix, from_parts, from_quaternion
from drivers.errors import ConfigError

TRIED = {
    "xyz+quaternion-xyzw": "quaternion xyzw", "xyz+quaternion-wxyz": "quaternion wxyz",
    "xyz+rotvec-rad": "rotation vector, in rad", "xyz+rpy-rad": "roll, pitch, yaw about fixed x, y, z, in rad",
    "xyz+rpy-deg": "roll, pitch, yaw about fixed x, y, z, in deg",
    "xyz+abc-deg": "KUKA's A, B, C about z, the new y, the new x, in deg",
    "xyz+zyz-deg": "Euler angles about z, the new y, the new z, in deg", "matrix-4x4": "4×4 matrix by rows",
    "matrix-4x4-by-columns": "4×4 matrix by columns",
}  # fmt: skip
"""The readings that are tried without being asked for, with a text for people."""
FORM = (
    "xyz+KIND or KIND+xyz, with KIND quaternion-xyzw, quaternion-wxyz, rotvec-rad, rpy-deg, or three axes such as "
    "ZYX-deg (about the turned axes) and zyx-rad (about the fixed ones); matrix-4x4, matrix-4x4-by-columns"
)
NAMED = re.compile(r"(xyz\+)?(?:quaternion-(xyzw|wxyz)|(rotvec|rpy|abc|[xyz]{3}|[XYZ]{3})-(rad|deg))(\+xyz)?")
SEQUENCES = {"rpy": "xyz", "abc": "ZYX", "zyz": "ZYZ"}


@dataclass(frozen=True)
class PoseReading:
    """A meaning of `count` numbers by its name for --poses."""

    name: str

    @property
    def count(self) -> int:
        """How many numbers it takes."""
        return 16 if self.name.startswith("matrix") else 7 if "quaternion" in self.name else 6

    @property
    def text(self) -> str:
        """The reading in words."""
        return TRIED.get(self.name, self.name)

    def pose(self, numbers: Array) -> pin.SE3:
        """The pose of numbers (count,), lengths as they are. Raises ValueError where they are none."""
        found = NAMED.fullmatch(self.name)
        if found is None:
            return _matrix(numbers.reshape(4, 4).T if self.name.endswith("columns") else numbers.reshape(4, 4))
        turn, place = (numbers[3:], numbers[:3]) if found[1] else (numbers[:-3], numbers[-3:])
        if found[2]:
            return from_quaternion(place, turn if found[2] == "xyzw" else turn[[1, 2, 3, 0]])
        if found[3] == "rotvec":
            return from_parts(place, Rotation.from_rotvec(turn, degrees=found[4] == "deg").as_matrix())
        rotation = Rotation.from_euler(SEQUENCES.get(found[3], found[3]), turn, degrees=found[4] == "deg")
        return from_parts(place, rotation.as_matrix())


def _matrix(whole: Array) -> pin.SE3:
    """The pose of a 4×4. Some write zeros where the last 1 belongs."""
    last, rotation = whole[3], whole[:3, :3]
    if np.abs(last[:3]).max() > 1e-6 or min(abs(last[3] - 1), abs(last[3])) > 1e-6:
        raise ValueError(f"its last row is {last.tolist()}, not 0 0 0 1")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ORTHOGONAL_OFF:
        raise ValueError(f"its 3×3 is no rotation: {np.round(rotation, 4).tolist()}")
    return from_matrix(np.vstack([whole[:3], [0.0, 0.0, 0.0, 1.0]]))


def readings_of(count: int, named: str, wanted: str | None) -> list[PoseReading]:
    """The readings of so many numbers, those that the names beside them allow, or the one that was asked for. `named`
    is a record's: "quaternion" or "rotation" (position first), or empty."""
    if wanted is None and named == "quaternion":
        wanted = "xyz+quaternion-xyzw"
    return [r for r in map(PoseReading, TRIED if wanted is None else (wanted,)) if r.count == count]


def check_reading(name: str | None) -> None:
    """ConfigError for a name that --poses does not know."""
    found = None if name is None else NAMED.fullmatch(name)
    good = found is not None and bool(found[1]) != bool(found[5])
    if good and found is not None and found[3] not in (None, "rotvec", *SEQUENCES):
        good = all(a != b for a, b in zip(found[3], found[3][1:], strict=False))
    if name is not None and not good and name not in TRIED:
        raise ConfigError(f"--poses {name}: unknown, allowed is {FORM}")


def why_not(numbers: Array, named: str, wanted: str | None) -> str:
    """Why no reading makes a pose of these numbers (n,)."""
    if not np.isfinite(numbers).all():
        return "it holds values that are not finite"
    for reading in readings_of(len(numbers), named, wanted):
        try:
            reading.pose(numbers)
        except ValueError as error:
            return str(error)
    what = f"which --poses {wanted} does not mean" if wanted else f"a pose has {', '.join(map(str, COUNTS))}"
    return f"it holds {len(numbers)} numbers, {what}"
