"""The laser's pointing and roll since the calibration, by the line on a plate that is fixed to the claw.

At one end of its travel the rail shows the scan camera that plate, with each calibration and before each job. What the
line has moved is taken for a turn of the light plane about the laser's exit; a shift of the camera's picture looks the
same there and does the same to depths. A roll about the beam leaves the line's middle where it was and turns the line;
it tilts a scan by as many times its angle as the sheet is steep. docs/explanation/theory.md, section 7.
"""

import time
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane, triangulate
from drivers.errors import Measured, RefusedError

SIGMAS = 3.0
NOTED_RAD = 0.1e-3
"""A roll that people are told of, if it is more than so many standard deviations, too."""
CORRELATED = 1.4
"""Rows side by side share their speckle: 36 looks at plates that nobody touched scatter so much more."""
LARGEST_RAD = 0.7e-3
"""As of the laser's pointing: beyond it more likely something was knocked."""


@dataclass(frozen=True)
class Roll:
    """How far the sheet has rolled, rad, and one standard deviation of it by the picture's noise."""

    angle: float
    sigma: float

    @property
    def open(self) -> float:
        """The roll that is reckoned with, rad; 0 where it is too small for a word."""
        return self.angle if abs(self.angle) > max(NOTED_RAD, SIGMAS * self.sigma) else 0.0

    @property
    def stated(self) -> float:
        """The deviation that a job has to reckon with, which has nothing but the plate to go by, rad."""
        return float(np.hypot(self.sigma, self.open))

    def require(self) -> None:
        """Raise `RefusedError` for a roll that no warmth makes."""
        if abs(self.open) <= LARGEST_RAD:
            return
        raise RefusedError(
            f"the laser's line on the plate on the claw is turned by {1e3 * self.angle:+.2f} ± {1e3 * self.sigma:.2f} "
            f"mrad against the calibration, allowed are ±{1e3 * LARGEST_RAD:g} mrad: the laser has turned in its mount "
            "about its own beam, or the plate is bent. Look at the screws of both, then run `cell calibrate`",
            Measured("the laser's line has turned by", 1e3 * self.angle, "mrad", most=1e3 * LARGEST_RAD),
        )


def rolled(plane: LightPlane, exit_point: Array, angle: float) -> LightPlane:
    """The light plane turned by `angle`, rad, about its beam's middle, through the laser's exit, camera frame."""
    return _leaning(plane, exit_point, angle, _stripe(plane))


def roll_of(moved: Array, by_roll: Array) -> Roll:
    """From what the line has moved on rows (n,), rising, in px, and what a roll moves there, px per rad. By the medians
    of the upper and the lower third: a speck on the plate moves some rows only."""
    third = max(1, len(moved) // 3)
    ends = slice(None, third), slice(-third, None)
    (high, low), (high_gain, low_gain) = ([float(np.median(v[end])) for end in ends] for v in (moved, by_roll))
    gain = low_gain - high_gain
    scatter = [1.4826 * float(np.median(np.abs(moved[end] - np.median(moved[end])))) for end in ends]
    noise = CORRELATED * 1.25 * float(np.linalg.norm(scatter)) / np.sqrt(third)
    return Roll((low - high) / gain, noise / abs(gain))


LEAST_ROWS = 40
"""Fewer rows of the plate in the picture are no witness."""
PLATE_M = 20e-6
"""One standard deviation of how far off the plate, its mount on the claw and the rail are that nobody touched."""
SAME_RAIL_M = 50e-6
"""The carriage has to be where it was: the plate may be tilted, and the rail is not along the camera's rows."""


@dataclass(frozen=True)
class Edge:
    """Where the line leaves the plate: the rail's `place`, m, mean of to and fro, and how late, s, the pictures come by
    the difference of the two (`lag`, the play of the screw with it)."""

    place: float
    lag: float


@dataclass(frozen=True, eq=False)
class PlateLine:
    """The line on the plate with the rail at `rail` m: its column (height,) in px, NaN where it is not seen; `edge` of
    the plate, where one was found."""

    rail: float
    columns: Array
    edge: Edge | None = None

    def as_dict(self) -> dict[str, object]:
        """For storage."""
        rows = self.rows
        where = {"height": len(self.columns), "rows": rows.tolist(), "columns": self.columns[rows].tolist()}
        return {"rail": self.rail, **where, "edge": None if self.edge is None else vars(self.edge)}

    @classmethod
    def read(cls, data: dict[str, Any] | None) -> Self | None:
        """From storage; KeyError, TypeError, ValueError or IndexError when it is none."""
        if data is None:
            return None
        columns = np.full(int(data["height"]), np.nan)
        columns[np.array(data["rows"], dtype=np.intp)] = data["columns"]
        return cls(float(data["rail"]), columns, read_edge(data.get("edge")))

    @property
    def rows(self) -> NDArray[np.intp]:
        """The rows (n,) that show it."""
        return np.flatnonzero(np.isfinite(self.columns))


@dataclass(frozen=True)
class Pointing:
    """How far the light plane has turned since the calibration, rad, and one standard deviation of it.

    `confirmed` is how much of the turn a verification has seen on its board. Where the rest is beyond `NOTED_RAD`, the
    deviation in `stated` has it in it: it may as well be the plate that has moved. `roll` is how far the plane has
    turned about its beam, rad, 0 where it is too small for a word, and `roll_sigma` what is stated of that.
    """

    turn: float
    sigma: float
    confirmed: float = 0.0
    roll: float = 0.0
    roll_sigma: float = 0.0

    @property
    def open(self) -> float:
        """The turn that only the plate tells of, rad; 0 where it is too small for a word."""
        rest = self.turn - self.confirmed
        return rest if abs(rest) > NOTED_RAD else 0.0

    @property
    def stated(self) -> Self:
        """With the deviation that a job has to reckon with, which has nothing but the plate to go by."""
        return replace(self, sigma=float(np.hypot(self.sigma, self.open)))

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, what is not as usual."""
        made = [self.words] if self.open else []
        if self.roll:
            made.append(
                f"the laser's line on the plate on the claw has turned by {1e3 * self.roll:+.3f} mrad since the "
                "calibration: the laser about its beam, or the plate; the measurements allow for either. Look at the "
                "screws of both, then run `cell calibrate`"
            )
        return tuple(made)

    @property
    def words(self) -> str:
        """How far it has turned, in words."""
        known = f", of which {1e3 * self.confirmed:+.3f} mrad were seen on a board," if self.confirmed else ""
        return (
            f"the laser points {1e3 * self.turn:+.3f} ± {1e3 * self.sigma:.3f} mrad from where it pointed at the "
            f"calibration{known} if the plate that shows it has not moved; the measurements allow for either, and "
            "`cell calibrate verify` tells them apart and keeps what it finds for the next jobs"
        )


@dataclass(frozen=True)
class ConfirmedTurn:
    """A turn of the laser since the calibration that the board of a verification has shown: `turn` ± `sigma`, rad.

    `plate` is the turn that the plate on the claw told at the same time, rad, right or wrong: from then on the plate
    tells only how much further the laser has turned. `made` is in seconds since the epoch.
    """

    plate: float
    turn: float
    sigma: float
    made: float

    def since(self, seen: Pointing) -> Pointing:
        """The turn since the calibration, from what the plate tells now."""
        turn = self.turn + seen.turn - self.plate
        return Pointing(turn, float(np.hypot(seen.sigma, self.sigma)), self.turn)

    @classmethod
    def read(cls, data: dict[str, Any] | None) -> Self | None:
        """From storage; KeyError, TypeError or ValueError when it is none."""
        if data is None:
            return None
        plate, turn, sigma, made = (float(data[name]) for name in ("plate", "turn", "sigma", "made"))
        if not (np.isfinite([plate, turn, sigma, made]).all() and sigma > 0):
            raise ValueError(f"a confirmed turn of {turn} ± {sigma} rad")
        return cls(plate, turn, sigma, made)

    def summary(self) -> dict[str, object]:
        """For reports and people, units in the names."""
        return {
            "turned_mrad": round(1e3 * self.turn, 4),
            "sigma_mrad": round(1e3 * self.sigma, 4),
            "plate_mrad": round(1e3 * self.plate, 4),
            "date": time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.made)),
        }


def read_edge(data: dict[str, Any] | None) -> Edge | None:
    """From storage; KeyError, TypeError or ValueError when it is none."""
    if data is None:
        return None
    edge = Edge(float(data["place"]), float(data["lag"]))
    if not np.isfinite([edge.place, edge.lag]).all():
        raise ValueError(f"an edge of the witness at {edge.place} m, {edge.lag} s")
    return edge


def pointing(
    before: PlateLine, now: PlateLine, camera: CameraModel, plane: LightPlane, exit_point: Array,
    confirmed: ConfirmedTurn | None = None,
) -> Pointing:  # fmt: skip
    """What a job reckons with: `turn_seen`, refused with `RefusedError` where no warmth takes the line.

    With a turn that was `confirmed`, the plate is held against what it told then, or against the calibration, whichever
    leaves less open: a laser that is cold again points where it did at the calibration.
    """
    found = turn_seen(before, now, camera, plane, exit_point)
    if not abs(found.turn) <= LARGEST_RAD:
        raise RefusedError(
            f"the laser points {1e3 * found.turn:+.2f} mrad from where it pointed at the calibration, allowed are "
            f"±{1e3 * LARGEST_RAD:g} mrad, or the plate on the claw that shows it has moved: look at the plate and at "
            "the laser's and the camera's mounts, run `cell calibrate verify`, which tells which it was, then "
            "`cell calibrate`",
            Measured("the laser's pointing has moved by", 1e3 * found.turn, "mrad", most=1e3 * LARGEST_RAD),
        )
    ways = [found.stated] if confirmed is None else [found.stated, confirmed.since(found).stated]
    return replace(min(ways, key=lambda way: way.sigma), roll=found.roll, roll_sigma=found.roll_sigma)


def turn_seen(before: PlateLine, now: PlateLine, camera: CameraModel, plane: LightPlane, exit_point: Array) -> Pointing:
    """The turn of `plane` between two looks at the witness, about `exit_point` (3,), m, camera frame.

    Its deviation has the picture's noise and a plate that is off by `PLATE_M`. Raises `RefusedError` when the two looks
    cannot be compared.
    """
    if not abs(now.rail - before.rail) <= SAME_RAIL_M:
        raise RefusedError(
            f"the laser's witness was looked at with the rail at {1e3 * now.rail:.2f} mm, at the calibration at "
            f"{1e3 * before.rail:.2f} mm, allowed are ±{1e3 * SAME_RAIL_M:.2f} mm: set laser.witness to "
            f'"{1e3 * before.rail:.2f} mm" again, or run `cell calibrate`',
            Measured("the rail at the witness is off by", 1e3 * (now.rail - before.rail), "mm", most=1e3 * SAME_RAIL_M),
        )
    both = np.flatnonzero(np.isfinite(before.columns) & np.isfinite(now.columns))
    if len(both) < LEAST_ROWS:
        raise RefusedError(
            f"the laser's line is seen on {len(both)} rows of the witness that the calibration saw, at least "
            f"{LEAST_ROWS} are needed: is the witness clean and in its place? If so, run `cell calibrate`"
        )
    moved = now.columns[both] - before.columns[both]
    at = np.column_stack([before.columns[both], both.astype(np.float64)])
    points, _ = triangulate(camera, plane, at)
    step = 1e-4
    by_roll = (_columns(camera, rolled(plane, exit_point, step), points) - at[:, 0]) / step
    roll = roll_of(moved, by_roll)
    roll.require()
    moved = moved - roll.open * by_roll
    # A median: a speck on the plate moves some rows only.
    shift = float(np.median(moved))
    noise = 1.25 * float(1.4826 * np.median(np.abs(moved - shift))) / np.sqrt(len(both))
    per_rad = float(np.median(_columns(camera, turned(plane, exit_point, step), points) - at[:, 0])) / step
    nearer = points * (1.0 - PLATE_M / points[:, 2:])
    plate = float(np.median(_columns(camera, plane, nearer) - at[:, 0]))
    seen = float(np.hypot(noise, plate) / abs(per_rad))
    return Pointing(shift / per_rad, seen, roll=roll.open, roll_sigma=roll.stated)


def turned(plane: LightPlane, exit_point: Array, angle: float) -> LightPlane:
    """The light plane turned by `angle`, rad, about the stripe's direction through the laser's exit, camera frame."""
    return _leaning(plane, exit_point, angle, np.cross(_stripe(plane), plane.n))


def _stripe(plane: LightPlane) -> Array:
    stripe = np.cross(plane.n, np.cross(plane.along, plane.n))
    return np.asarray(stripe / np.linalg.norm(stripe))


def _leaning(plane: LightPlane, exit_point: Array, angle: float, towards: Array) -> LightPlane:
    """With its normal turned by `angle`, rad, `towards` a direction in the plane (3,)."""
    normal = np.cos(angle) * plane.n + np.sin(angle) * towards
    # The exit is known as drawn; off the plane by what it is, it stays off by as much.
    off = float(plane.n @ exit_point) - plane.distance
    return LightPlane.of(normal, float(normal @ exit_point) - off).bowed(plane.bow)


def _columns(camera: CameraModel, plane: LightPlane, points: Array) -> Array:
    """Columns (n,) at which `plane` shows on a plate across the optical axis at the depths of `points` (n, 3)."""
    at = points.copy()
    for _ in range(3):
        at[:, 0] -= plane.distances(at) / plane.normal[0]
    return np.asarray(camera.project(at)[:, 0])
