"""A vehicle that rocks on its tyres while the laser sweeps: seen in the scan's lines, and told apart from the pose.

The arm's base rocks with it, so that every line is displaced, up and down with a frequency of a few hertz. Its lines'
mean distances from the surface show the frequency; two angles, each with a sine and a cosine, are then found along with
the surface's pose. What it is when the part is put down nobody knows: that is in the error budget.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.inversion.closest import Array
from cell.inversion.correspondences import Scan, correspondences
from cell.inversion.nominal import NominalSurface
from cell.reconstruction.cloud import Cloud
from drivers.errors import Measured, RefusedError

SLOWEST_HZ, FASTEST_HZ, STEP_HZ = 1.5, 14.0, 0.05
LEAST_LINES = 40
EVIDENCE = 40.0
"""Drop of the lines' squares, in units of what is left of them, that chance does not bring in so many frequencies."""
LEAST_M = 8e-6
"""Less than this, up and down, is not worth a word: a screw's error looks the same."""
LARGEST_OVERTONES = 0.05
"""Twice and three times the frequency against itself: rocking has 0.006 at most, ridges and steps 0.14 and more."""
GATE_M = 0.5e-3
EXPECTED_RAD = 1e-3
"""One standard deviation of each angle before the scan has told: as good as unknown."""
LARGEST_RAD = 0.4e-3
"""Beyond this the part cannot be put down well either."""


@dataclass(frozen=True)
class Rocking:
    """How the vehicle rocked: `hz`, and `height` in m by which the scanned surface seemed to go up and down.

    Waves of the length `wave`, m, on the surface itself would look the same.
    """

    hz: float
    height: float
    wave: float


def find_rocking(cloud: Cloud, nominal: NominalSurface, base_from_surface: pin.SE3, times: Array) -> Rocking | None:
    """The rocking that a scan's lines, taken at `times` (lines,) in s, show at the pose found; None without any.

    None as well where the lines go up and down with overtones: a vehicle on its springs has none, ridges have.
    """
    scan = Scan.of(cloud)
    rows = correspondences(base_from_surface, scan, nominal, GATE_M)
    of = scan.lines[rows.index]
    count = np.bincount(of, minlength=cloud.shape[0])
    good = count >= 8
    if np.count_nonzero(good) < LEAST_LINES:
        return None
    mean = np.bincount(of, rows.heights, minlength=cloud.shape[0])[good] / count[good]
    t = times[good]
    t = t - t.mean()
    apart = float(np.median(np.diff(np.sort(t))))
    # Slow changes are the surface's or the pose's own business.
    trend = np.vander(t / np.ptp(t), 4)
    mean = mean - trend @ np.linalg.lstsq(trend, mean, rcond=None)[0]
    best, hz, height = 0.0, 0.0, 0.0
    for candidate in np.arange(SLOWEST_HZ, min(FASTEST_HZ, 0.45 / apart), STEP_HZ):
        waves = _waves(t, candidate)
        waves = waves - trend @ np.linalg.lstsq(trend, waves, rcond=None)[0]
        solution = np.linalg.lstsq(waves, mean, rcond=None)[0]
        left = float(np.sum((mean - waves @ solution) ** 2))
        evidence = (float(mean @ mean) - left) / (left / (len(t) - 6))
        if evidence > best:
            best, hz, height = evidence, float(candidate), float(np.hypot(*solution))
    if best < EVIDENCE or height < LEAST_M or _overtones(t, mean, hz, apart) > LARGEST_OVERTONES:
        return None
    points = np.column_stack([np.bincount(of, scan.points[rows.index, axis], minlength=len(good)) for axis in range(3)])
    speed = np.linalg.norm(np.median(np.diff(points[good] / count[good, None], axis=0), axis=0)) / apart
    return Rocking(hz, height, float(speed) / hz)


def rocking_motions(
    cloud: Cloud,
    lines: NDArray[np.intp],
    rows: NDArray[np.intp],
    base_from_vehicle: pin.SE3,
    times: Array,
    hz: float,
    size: float = EXPECTED_RAD,
) -> Array:
    """(n, 3, 4 s) displacements in m, base axes, of the points at (lines, rows) by the sine and the cosine of roll and
    pitch, each of `size` rad, in each of s sweeps."""
    arms = cloud.points[lines, rows] - base_from_vehicle.translation
    sweeps = cloud.sweeps[lines] if len(cloud.sweeps) else np.zeros(len(lines), dtype=np.intp)
    waves = _waves(times[lines], hz)
    count = int(sweeps.max()) + 1 if len(sweeps) else 1
    motions = np.zeros((len(lines), 3, 4 * count))
    for axis in range(2):
        turned = size * np.cross(base_from_vehicle.rotation[:, axis], arms)
        for wave in range(2):
            motions[np.arange(len(lines)), :, 4 * sweeps + 2 * axis + wave] = turned * waves[:, wave, None]
    return motions


def rocking_covariance(rocking: Rocking, base_from_vehicle: pin.SE3, at: Array) -> Array:
    """Covariance (6, 6), m² and rad², base axes, of a place `at` (3,), m, at a moment that nobody chose.

    Raises `RefusedError` when it rocks too much to put anything down.
    """
    arm = at - base_from_vehicle.translation
    axes = base_from_vehicle.rotation[:, :2]
    beside = float(np.linalg.norm(axes.T @ arm))
    angle = rocking.height / beside
    if angle > LARGEST_RAD:
        raise RefusedError(
            f"the vehicle rocks by ±{1e3 * angle:.2f} mrad at {rocking.hz:.1f} Hz, which moves the place by "
            f"±{1e3 * rocking.height:.2f} mm; allowed are ±{1e3 * LARGEST_RAD:g} mrad. Wait until it is quiet, see "
            "what shakes it, or lower its supports",
            Measured("the vehicle rocks by", 1e3 * angle, "mrad", most=1e3 * LARGEST_RAD),
        )
    columns = np.concatenate([np.cross(axes.T, arm).T, axes])
    return np.asarray(0.5 * angle**2 * columns @ columns.T)


def words(rocking: Rocking) -> str:
    """For people, where the scan fits without it as well."""
    return (
        f"the vehicle rocks, or {_instead(rocking)}: at {rocking.hz:.1f} Hz the surface seems to go up and down by "
        f"{1e3 * rocking.height:.3f} mm; the pose allows for rocking, and the stated uncertainty has what it does "
        "while the part is put down"
    )


def also(rocking: Rocking) -> str:
    """For people, beside the reason why a scan was refused. It fits rocking as well: too little to accept anything."""
    return (
        f"(or the vehicle rocks at {rocking.hz:.1f} Hz, by ±{1e3 * rocking.height:.3f} mm at the surface: wait until "
        f"it is quiet and run the job again; if that says the same, {_instead(rocking)})"
    )


def _instead(rocking: Rocking) -> str:
    return f"the surface has waves of {1e3 * rocking.wave:.1f} mm"


def _overtones(t: Array, mean: Array, hz: float, apart: float) -> float:
    """How large the waves of 2 and 3 times `hz` are that `mean` (n,) has at `t` (n,), against that of `hz` itself."""
    known = [hz]
    for overtone in (2 * hz, 3 * hz):
        # Between lines so far apart it may look like another frequency.
        seen = abs(overtone - round(overtone * apart) / apart)
        if min(abs(seen - other) for other in (0.0, *known)) > 2 / np.ptp(t):
            known.append(seen)
    waves = np.column_stack([_waves(t, one) for one in known])
    solution = np.linalg.lstsq(waves, mean, rcond=None)[0]
    left = float(np.sum((mean - waves @ solution) ** 2)) / (len(t) - 6)
    sizes = np.sum(solution.reshape(-1, 2) ** 2, axis=1)
    # What noise alone makes of them is not theirs.
    noise = (len(known) - 1) * 4 * left / len(t)
    return float(np.sqrt(max(0.0, sizes[1:].sum() - noise) / sizes[0]))


def _waves(t: Array, hz: float) -> Array:
    """(n, 2) sine and cosine."""
    return np.column_stack([np.sin(2 * np.pi * hz * t), np.cos(2 * np.pi * hz * t)])
