"""Has the light sheet rolled about its own beam since the calibration? The slope of the line on the claw's plate tells.

A roll leaves the middle of the line where it was, so that nothing of the laser's pointing shows it, and tilts a scan by
as many times its angle as the sheet is steep: three and a half times as the paper draws it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.measure.geometry.camera import Array
from cell.measure.geometry.light_plane import LightPlane
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
    stripe = np.cross(plane.n, np.cross(plane.along, plane.n))
    stripe /= np.linalg.norm(stripe)
    normal = np.cos(angle) * plane.n + np.sin(angle) * stripe
    # The exit is known as drawn; off the plane by what it is, it stays off by as much.
    off = float(plane.n @ exit_point) - plane.distance
    return LightPlane.of(normal, float(normal @ exit_point) - off).bowed(plane.bow)


def roll_of(moved: Array, by_roll: Array) -> Roll:
    """From what the line has moved on rows (n,), rising, in px, and what a roll moves there, px per rad.

    By the medians of the upper and the lower third: a speck on the plate moves some rows only.
    """
    third = max(1, len(moved) // 3)
    ends = slice(None, third), slice(-third, None)
    (high, low), (high_gain, low_gain) = ([float(np.median(v[end])) for end in ends] for v in (moved, by_roll))
    gain = low_gain - high_gain
    scatter = [1.4826 * float(np.median(np.abs(moved[end] - np.median(moved[end])))) for end in ends]
    noise = CORRELATED * 1.25 * float(np.linalg.norm(scatter)) / np.sqrt(third)
    return Roll((low - high) / gain, noise / abs(gain))
