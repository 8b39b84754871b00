"""What a simulated picture can show: boards, plane rectangles, meshes, the laser line and the ambient light.

Plain records without behaviour; every pose is a 4×4 matrix that maps the object's coordinates into the camera frame.
"""

import re
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.mesh import Mesh

Vector = NDArray[np.float64]
Pose = NDArray[np.float64]

KINDS = ("plain", "marked_dots", "asymmetric_dots", "dots", "chessboard")
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


@dataclass(frozen=True)
class Board:
    """A flat calibration target, seen from the side that its z axis points away from (x right, y down, z inwards).

    Dots lie at multiples of `pitch` from the first dot, diameter half the pitch; a chessboard's origin is its first
    inner corner. `cols`, `rows` count dots (or inner corners). One pitch of white surrounds the pattern.
    `asymmetric_dots`: dot (i, j) at ((2i + j mod 2) pitch, j pitch). `marked_dots`: the dots (c, r), (c+2, r),
    (c, r+1), c = (cols−1)//2, r = (rows−1)//2, are rings with a white centre of half the dot's diameter.
    """

    kind: str
    cols: int
    rows: int
    pitch: float
    white: float = 0.9
    black: float = 0.06

    def __post_init__(self) -> None:
        if self.kind not in KINDS[1:]:
            raise ValueError(f"board kind {self.kind!r}: use one of {', '.join(KINDS[1:])}")
        if self.cols < 2 or self.rows < 2 or not self.pitch > 0:
            raise ValueError(
                f"board {self.cols}x{self.rows}, pitch {self.pitch} m: needs at least 2x2 and a pitch above 0 m"
            )

    @classmethod
    def parse(cls, spec: str) -> Self:
        """Make a board of a text such as `marked_dots:9x7:20mm`; `ValueError` if it is not one."""
        match = re.fullmatch(r"(\w+):(\d+)x(\d+):([\d.]+)\s*(mm|cm|m)", spec)
        if match is None:
            raise ValueError(f"board {spec!r}: write KIND:COLSxROWS:PITCH with a unit, e.g. marked_dots:9x7:20mm")
        kind, cols, rows, pitch, unit = match.groups()
        return cls(kind, int(cols), int(rows), float(pitch) * UNITS[unit])

    @property
    def dot_radius(self) -> float:
        """Radius of a dot in m."""
        return self.pitch / 4

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Edges x0, x1, y0, y1 of the board's rectangle in the board frame, m."""
        across = self.cols - 1 if self.kind != "asymmetric_dots" else 2 * (self.cols - 1) + 1
        margin = 2.0 if self.kind == "chessboard" else 1.0
        p = self.pitch
        return -margin * p, (across + margin) * p, -margin * p, (self.rows - 1 + margin) * p

    @property
    def points(self) -> Vector:
        """(cols·rows, 3) dot centres or inner corners in the board frame, row by row, m."""
        j, i = np.mgrid[0 : self.rows, 0 : self.cols]
        x = 2 * i + j % 2 if self.kind == "asymmetric_dots" else i
        return np.column_stack([x.ravel(), j.ravel(), np.zeros(i.size)]) * self.pitch


@dataclass(frozen=True, eq=False)
class BoardInstance:
    """A board at a pose."""

    camera_from_board: Pose
    board: Board


@dataclass(frozen=True, eq=False)
class PlaneInstance:
    """A rectangle of `size` (m, m) about the origin of its x-y plane, one `albedo`, seen from both sides."""

    camera_from_plane: Pose
    size: tuple[float, float]
    albedo: float = 0.5


@dataclass(frozen=True)
class Puddle:
    """Oil on a surface: `centre` (x, y) and `radius` in the mesh's frame, `thickness` in the middle, m."""

    centre: tuple[float, float]
    radius: float
    thickness: float


@dataclass(frozen=True)
class Grain:
    """How a surface is uneven in colour and gloss, the same at the same place whenever it is seen.

    `texture`: RMS of the albedo, relative, in grains of 0.3 and 1 mm. `spots` of dust per cm², dark, 0.4 to 1 mm
    across.
    `gloss`: light mirrored straight into the camera, of that scattered, in a lobe of 0.2 rad. `oil`: where it is wet.
    """

    texture: float = 0.0
    spots: float = 0.0
    gloss: float = 0.0
    oil: Puddle | None = None


@dataclass(frozen=True, eq=False)
class MeshInstance:
    """A mesh at a pose, of one `albedo` with its `grain`, seen from both sides."""

    camera_from_mesh: Pose
    mesh: Mesh
    albedo: float = 0.6
    grain: Grain | None = None


SceneObject = BoardInstance | PlaneInstance | MeshInstance


@dataclass(frozen=True, eq=False)
class Sun:
    """A strip of light `strength` times what else lights it, over `low` ≤ x ≤ `high`, m, of the plane z = 0."""

    camera_from_ground: Pose
    low: float
    high: float
    strength: float


@dataclass(frozen=True)
class Light:
    """Ambient light of `level` 1 in an ordinary room.

    `gradient` is the relative change of light across the image's width and height, `direction` the unit vector to the
    lamp in the camera frame (None: the lamp is beside the lens) and `diffuse` the share that comes from everywhere.
    `surroundings` is the albedo of all that no object covers.
    """

    level: float = 1.0
    gradient: tuple[float, float] = (0.08, 0.05)
    direction: tuple[float, float, float] | None = None
    diffuse: float = 0.6
    surroundings: float = 0.35
    suns: tuple[Sun, ...] = ()


@dataclass(frozen=True)
class LaserOptics:
    """A line laser in the camera frame: light plane n·P = d with unit `normal` n and `distance` d in m.

    `origin` is where the fan starts (its nearest point on the plane is used), `fan` the half angle in rad about the
    camera's z direction. `width` is the standard deviation of the sheet's thickness in m. `brightness` in DN/s: the
    sharp image of a white (albedo 1) surface that faces the laser at 0.130 m. `speckle_contrast` is C, the relative
    standard deviation of a pixel's light, `speckle_px` the standard deviation of the grain's correlation kernel.
    `bow`: the sheet is off its plane by bow · y²/r, with y across the fan's middle and r along it, m. `end`: angle from
    the middle, rad, at which the fan has faded to a half (0: never). `shadows` of dust on its window: angle, half width
    (rad), share of light taken.
    """

    origin: tuple[float, float, float] = (-0.035, 0.0, 0.0)
    normal: tuple[float, float, float] = (3.5 / 3.640054944640259, 0.0, -1.0 / 3.640054944640259)
    distance: float = -0.035 * 3.5 / 3.640054944640259
    fan: float = field(default=np.deg2rad(30.0))
    width: float = 80e-6
    brightness: float = 1.25e5
    speckle_contrast: float = 0.15
    speckle_px: float = 0.5
    bow: float = 0.0
    end: float = 0.0
    shadows: tuple[tuple[float, float, float], ...] = ()
