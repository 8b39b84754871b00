"""What moves while the laser sweeps: the vehicle on its tyres, and the carriage on its guide.

A vehicle that rocks on its tyres while the laser sweeps: seen in the scan's lines, and told apart from the pose.

The arm's base rocks with it, so that every line is displaced, up and down with a frequency of a few hertz. Its lines'
mean distances from the surface show the frequency; two angles, each with a sine and a cosine, are then found along with
the surface's pose. What it is when the part is put down nobody knows: that is in the error budget.

A scan head's carriage that sinks along its travel: seen as a bow of the scan along the rail, stated as a tilt.

A worn guide lets the carriage sink by the square of its way. The scanned surface then seems bowed the other way; the
constant and the even slope of that go into the pose, unseen. The bow tells how large they may be. A surface that is
bent along the sweep looks the same, so the pose is not corrected: what the carriage may have done to it is added to
its covariance."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.inversion.nominal import Array, NominalSurface, Scan, correspondences
from cell.measure.reconstruction.cloud import Cloud, Indices
from drivers.errors import Measured, RefusedError

SLOWEST_HZ, FASTEST_HZ, STEP_HZ = 1.5, 14.0, 0.05
LEAST_LINES = 40
LEAST_POINTS, POINTS = 8, 40
"""Of a line that counts; of each line that are looked at, in a dense scan."""
FEWEST = 20
"""Lines of one sweep of several that tell something."""
EVIDENCE = 40.0
"""Drop of the lines' squares, in units of what is left of them, that chance does not bring in so many frequencies."""
LEAST_M = 8e-6
"""Less than this, up and down, is not worth a word: a screw's error looks the same."""
LARGEST_OVERTONES = 0.05
"""Twice and three times the frequency against itself: rocking has 0.006 at most, ridges and steps 0.14 and more."""
GATE_M = 0.5e-3
EXPECTED_RAD = 1e-3
"""One standard deviation of each angle before the scan has told: as good as unknown."""
LEAST_LEVER_M = 0.01
"""A board that a roll hardly moves before the camera tells of none: what swings there is refused as a large one."""
LARGEST_RAD = 0.4e-3
"""Beyond this the part cannot be put down well either."""


@dataclass(frozen=True)
class Rocking:
    """How the vehicle rocked: `hz`, and `height` in m by which the scanned surface seemed to go up and down. Waves of
    the length `wave`, m, on the surface itself would look the same."""

    hz: float
    height: float
    wave: float


def find_rocking(cloud: Cloud, nominal: NominalSurface, base_from_surface: pin.SE3, times: Array) -> Rocking | None:
    """The rocking that a scan's lines, taken at `times` (lines,) in s, show at the pose found; None without any. None
    as well where the lines go up and down with overtones: a vehicle on its springs has none, ridges have."""
    scan = Scan.of(cloud, max(10_000, POINTS * cloud.shape[0]))
    rows = correspondences(base_from_surface, scan, nominal, GATE_M)
    of = scan.lines[rows.index]
    count = np.bincount(of, minlength=cloud.shape[0])
    good = count >= LEAST_POINTS
    mean = np.bincount(of, rows.heights, minlength=cloud.shape[0])[good] / count[good]
    sums = [np.bincount(of, scan.points[rows.index, axis], minlength=len(good)) for axis in range(3)]
    places = np.column_stack(sums)[good] / count[good, None]
    sweeps = cloud.sweep_of[good]
    lines_of = [np.flatnonzero(sweeps == k) for k in np.unique(sweeps)]
    made = [_Sweep.of(times[good][here], mean[here], places[here]) for here in lines_of]
    known = [sweep for sweep in made if sweep is not None]
    if sum(len(sweep.times) for sweep in known) < LEAST_LINES:
        return None
    best, hz = _strongest(known)
    # Each sweep brings a phase of its own, and chance with it.
    if best < EVIDENCE * len(known):
        return None
    height = max(float(np.hypot(*sweep.waves(hz)[1])) for sweep in known)
    if height < LEAST_M or max(sweep.overtones(hz) for sweep in known) > LARGEST_OVERTONES:
        return None
    return Rocking(hz, height, float(np.median([sweep.speed for sweep in known])) / hz)


def _strongest(known: "list[_Sweep]") -> tuple[float, float]:
    """The frequency, Hz, that explains most of the sweeps' heights, after the evidence for it."""
    fastest = min(FASTEST_HZ, *(0.45 / sweep.apart for sweep in known))
    best, hz = 0.0, 0.0
    for candidate in np.arange(SLOWEST_HZ, fastest, STEP_HZ):
        left = sum(sweep.left(candidate) for sweep in known)
        free = sum(len(sweep.times) - 6 for sweep in known)
        evidence = (sum(float(sweep.heights @ sweep.heights) for sweep in known) - left) / (left / free)
        if evidence > best:
            best, hz = evidence, float(candidate)
    return best, hz


@dataclass(frozen=True, eq=False)
class _Sweep:
    """One sweep's lines: `times` (n,) from its middle, mean `heights` (n,) less what changes slowly, which is `trend`'s
    (n, 4); the median time from line to line and the speed over the surface."""

    times: Array
    heights: Array
    trend: Array
    apart: float
    speed: float

    @classmethod
    def of(cls, times: Array, heights: Array, places: Array) -> "_Sweep | None":
        """None for one that is too short or whose times do not tell its lines apart."""
        t = times - times.mean()
        steps = np.diff(t)
        if len(t) < FEWEST or not (apart := float(np.median(steps))) > 0 or np.any(steps <= 0):
            return None
        # Slow changes are the surface's or the pose's own business.
        trend = np.vander(t / np.ptp(t), 4)
        slow = trend @ np.linalg.lstsq(trend, heights, rcond=None)[0]
        speed = float(np.linalg.norm(np.median(np.diff(places, axis=0), axis=0))) / apart
        return cls(t, heights - slow, trend, apart, speed)

    def waves(self, *hz: float) -> tuple[Array, Array]:
        """Sines and cosines (n, 2 k) of k frequencies, less the trend, and the size (2 k,) of each in the heights."""
        waves = np.concatenate([_waves(self.times, one) for one in hz], axis=1)
        waves = waves - self.trend @ np.linalg.lstsq(self.trend, waves, rcond=None)[0]
        return waves, np.asarray(np.linalg.lstsq(waves, self.heights, rcond=None)[0])

    def left(self, *hz: float) -> float:
        """Sum of the squares, m², without these frequencies."""
        waves, sizes = self.waves(*hz)
        return float(np.sum((self.heights - waves @ sizes) ** 2))

    def overtones(self, hz: float) -> float:
        """How large the waves of 2 and 3 times `hz` are against that of `hz` itself."""
        known = [hz]
        for overtone in (2 * hz, 3 * hz):
            # Between lines so far apart it may look like another frequency.
            seen = abs(overtone - round(overtone * self.apart) / self.apart)
            if min(abs(seen - other) for other in (0.0, *known)) > 2 / np.ptp(self.times):
                known.append(seen)
        squares = np.sum(self.waves(*known)[1].reshape(-1, 2) ** 2, axis=1)
        # What noise alone makes of them is not theirs.
        noise = (len(known) - 1) * 4 * self.left(*known) / (len(self.times) - 6) / len(self.times)
        return float(np.sqrt(max(0.0, squares[1:].sum() - noise) / squares[0]))


def rocking_motions(
    cloud: Cloud, lines: NDArray[np.intp], rows: NDArray[np.intp], base_from_vehicle: pin.SE3, times: Array, hz: float,
    size: float = EXPECTED_RAD,
) -> Array:  # fmt: skip
    """(n, 3, 4 s) displacements in m, base axes, of the points at (lines, rows) by the sine and the cosine of roll and
    pitch, each of `size` rad, in each of s sweeps."""
    arms = cloud.points[lines, rows] - base_from_vehicle.translation
    sweeps = cloud.sweep_of[lines]
    waves = _waves(times[lines], hz)
    count = int(sweeps.max()) + 1 if len(sweeps) else 1
    motions = np.zeros((len(lines), 3, 4 * count))
    for axis in range(2):
        turned = size * np.cross(base_from_vehicle.rotation[:, axis], arms)
        for wave in range(2):
            motions[np.arange(len(lines)), :, 4 * sweeps + 2 * axis + wave] = turned * waves[:, wave, None]
    return motions


def rocking_covariance(rocking: Rocking | None, base_from_vehicle: pin.SE3, at: Array, roll: float = 0.0) -> Array:
    """Covariance (6, 6), m² and rad², base axes, of a place `at` (3,), m, at a moment that nobody chose.

    By ±`roll` rad the vehicle rolls in photographs; the heights of a scan before the vehicle do not show it. Raises
    `RefusedError` when it rocks too much to put anything down.
    """
    arm = at - base_from_vehicle.translation
    axes = base_from_vehicle.rotation[:, :2]
    angle = 0.0
    if rocking is not None:
        angle = rocking.height / float(np.linalg.norm(axes.T @ arm))
        require_firm(angle, rocking.height, "the place", rocking.hz)
    columns = np.concatenate([np.cross(axes.T, arm).T, axes]) * [max(angle, roll), angle]
    return np.asarray(0.5 * columns @ columns.T)


def roll_of(swung: float, base_from_board: pin.SE3, base_from_vehicle: pin.SE3) -> float:
    """The roll, rad, of a vehicle that moves a board to and fro by `swung` m before a camera that looks square at it. A
    pitch moves such a board mostly along the camera's axis; the heights of a scan show it instead."""
    moved = np.cross(base_from_vehicle.rotation[:, 0], base_from_board.translation - base_from_vehicle.translation)
    seen = base_from_board.rotation[:, :2].T @ moved
    return swung / max(float(np.linalg.norm(seen)), LEAST_LEVER_M) if swung else 0.0


def require_firm(angle: float, moved: float, what: str, hz: float | None = None) -> None:
    """Raise `RefusedError` for a vehicle that rocks by ±`angle` rad, which moves `what` by ±`moved` m."""
    if not angle <= LARGEST_RAD:
        often = "" if hz is None else f" at {hz:.1f} Hz"
        raise RefusedError(
            f"the vehicle rocks by ±{1e3 * angle:.2f} mrad{often}, which moves {what} by ±{1e3 * moved:.2f} mm; "
            f"allowed are ±{1e3 * LARGEST_RAD:g} mrad. Wait until it is quiet, see what shakes it, or lower its "
            "supports",
            Measured("the vehicle rocks by", 1e3 * angle, "mrad", most=1e3 * LARGEST_RAD),
        )


def words(rocking: Rocking) -> str:
    """For people, where the scan fits without it as well."""
    return (
        f"the vehicle rocks, or the surface has waves of {1e3 * rocking.wave:.1f} mm: at {rocking.hz:.1f} Hz the "
        f"surface seems to go up and down by {1e3 * rocking.height:.3f} mm; the pose allows for rocking, and the "
        "stated uncertainty has what it does while the part is put down"
    )


def _waves(t: Array, hz: float) -> Array:
    """(n, 2) sine and cosine."""
    return np.column_stack([np.sin(2 * np.pi * hz * t), np.cos(2 * np.pi * hz * t)])


LEAST_DROOP_LINES, LEAST_SHARE = 40, 0.1
LEAST_SAG = 36e-6
"""At the end of the travel, m. Calibration and facets make a bow of up to 33 µm (docs/explanation/theory.md, section
8)."""
DROOP_EVIDENCE = 4.0
"""The bow over its own standard deviation."""
BLOCK, BLOCKS = 12, 20
"""Neighbouring lines whose errors count as one, and how many such blocks a dense scan has: they share facets of the
drawing and the part's form."""
ROLL = 10.0
"""How far the carriage rolls about its way while it sinks, rad per m: guides 0.1 m apart, of which one is worn."""


@dataclass(frozen=True, eq=False)
class Head:
    """The scan head in the base for each line of a cloud: the `cameras` (lines, 3) m, their optical `axes` and the
    `ways` of the rail, unit vectors (lines, 3), and the carriage's way as a `share` (lines,) of its travel."""

    cameras: Array
    axes: Array
    ways: Array
    share: Array

    @classmethod
    def of(
        cls, cloud: Cloud, base_from_flange: pin.SE3, flange_from_camera: pin.SE3, rail_direction: Array, travel: float
    ) -> "Head":
        """`rail_direction` is the camera's travel per metre of the rail in its own frame; `base_from_flange` holds
        where the cloud does not tell the flange of each line."""
        flanges = cloud.flanges if len(cloud.flanges) else np.tile(base_from_flange.homogeneous, (cloud.shape[0], 1, 1))
        cameras = flanges @ flange_from_camera.homogeneous
        moved = cameras[:, :3, :3] @ rail_direction
        ways = moved / np.linalg.norm(rail_direction)
        return cls(cameras[:, :3, 3] + cloud.rail[:, None] * moved, cameras[:, :3, 2], ways, cloud.rail / travel)


@dataclass(frozen=True, eq=False)
class Droop:
    """How far the carriage may have sunk at the end of its travel: `sag`, m, and its standard deviation `sigma`."""

    sag: float
    sigma: float
    head: Head

    def motions(self, cloud: Cloud, lines: Indices, rows: Indices) -> Array:
        """(n, 3, 2) displacements in m, base axes, of the points at (lines, rows): by the sag and by the roll."""
        head = self.head
        sunk = np.hypot(self.sag, self.sigma) * head.share[lines, None] ** 2
        arms = cloud.points[lines, rows] - head.cameras[lines]
        return np.stack([sunk * head.axes[lines], sunk * ROLL * np.cross(head.ways[lines], arms)], axis=2)

    @property
    def words(self) -> str:
        """For people."""
        return (
            f"the scan is bowed along the rail, as if its carriage had sunk by {1e3 * abs(self.sag):.2f} ± "
            f"{1e3 * self.sigma:.2f} mm at the end of its travel, or the surface were bent; the stated uncertainty "
            "allows for the carriage. Look for play in its guide, then run `cell calibrate`"
        )


def find_droop(cloud: Cloud, nominal: NominalSurface, base_from_surface: pin.SE3, head: Head) -> Droop | None:
    """The sag that a scan shows at the pose found; None without any, and where the carriage stood still."""
    measured = bow(cloud, nominal, base_from_surface, head)
    if measured is None:
        return None
    sag, sigma = measured
    return Droop(sag, sigma, head) if abs(sag) > max(LEAST_SAG, DROOP_EVIDENCE * sigma) else None


def bow(cloud: Cloud, nominal: NominalSurface, pose: pin.SE3, head: Head) -> tuple[float, float] | None:
    """The sag that fits best and its standard deviation, m; each sweep may lie and lean by itself."""
    scan = Scan.of(cloud, max(10_000, POINTS * cloud.shape[0]))
    found = correspondences(pose, scan, nominal, GATE_M)
    of = scan.lines[found.index]
    facing = np.einsum("ni,ni->n", found.normals, head.axes[of])
    good = np.bincount(of, minlength=cloud.shape[0]) >= LEAST_POINTS
    if np.count_nonzero(good) < LEAST_DROOP_LINES or float(np.ptp(head.share[good])) < LEAST_SHARE:
        return None
    # Least squares of each line: how far it lies off along the camera's axis.
    square = np.bincount(of, facing**2, minlength=cloud.shape[0])[good]
    off = np.bincount(of, facing * found.heights, minlength=cloud.shape[0])[good] / np.maximum(square, 1e-6)
    sweeps = cloud.sweep_of[good]
    way = head.share[good]
    own = (sweeps[:, None] == np.unique(sweeps)).astype(np.float64)
    columns = np.hstack([(way**2)[:, None], own, own * way[:, None]])
    inverse = np.linalg.pinv(columns)
    sizes = inverse @ off
    left = off - columns @ sizes
    # What neighbouring lines share counts once.
    blocks = np.arange(len(off)) // max(BLOCK, len(off) // BLOCKS)
    moved = np.array([inverse[0, blocks == k] @ left[blocks == k] for k in range(blocks[-1] + 1)])
    return float(sizes[0]), float(np.linalg.norm(moved))
