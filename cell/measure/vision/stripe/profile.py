"""What the extraction of a stripe may assume, and what it gives: centres with a standard deviation each.

What is to be known of single points of a stripe: where the surface or another light may have moved the centre.

A mark says why a centre may be off by more than its deviation states; the point stays. Who wants only points without
reproach takes those without marks."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.ordinary.speckle import Speckle

if TYPE_CHECKING:
    from cell.measure.vision.stripe.careful.careful import Learned


Array = NDArray[np.float64]


class Mark(IntFlag):
    """Why a point may be off."""

    NONE = 0
    SATURATED = 1
    """The core is at the end of the camera's range: the flanks alone say where the centre is."""
    SECOND_LINE = 2
    """Another peak in the line is comparable to the stripe's."""
    REFLECTION = 4
    """Fainter light beside the stripe, such as surfaces throw at each other, or a profile unlike the others'."""
    ALBEDO_EDGE = 8
    """The stripe's brightness changes abruptly: an edge across it pulls the centre to its brighter side."""
    STEP = 16
    """The centre jumps: an edge of the scene, where the stripe's light may come from both sides."""


SECOND, FAINT = 0.35, 0.1
"""Height of the next best peak over the stripe's."""
UNLIKE = 3.5
"""Misfit over what is usual in the picture."""
STEP_PX, STEP_WIDTHS, STEP_SIGMAS = 2.0, 0.8, 8.0
BRIGHTER, BRIGHTER_SCATTERS = 0.35, 5.0
"""Change of the brightness's logarithm, at least, and in units of its scatter from line to line."""
NEAR, SIDE = 2, 5
"""Lines on either side of an edge that it reaches, and those that say how bright a side is."""
LONGEST_GAP = 24


def marks_of(profile: StripeProfile) -> NDArray[np.uint8]:
    """The marks (lines,) of a profile, sums of `Mark`; 0 also where there is no stripe."""
    marks = np.zeros(len(profile.centres), np.uint8)
    marks[profile.saturated] |= np.uint8(Mark.SATURATED)
    marks[profile.double] |= np.uint8(Mark.SECOND_LINE)
    if profile.rival is not None:
        marks[profile.rival > SECOND] |= np.uint8(Mark.SECOND_LINE)
        marks[(profile.rival > FAINT) & (profile.rival <= SECOND)] |= np.uint8(Mark.REFLECTION)
    if profile.misfit is not None:
        marks[np.nan_to_num(profile.misfit) > UNLIKE] |= np.uint8(Mark.REFLECTION)
    rows = profile.rows
    if len(rows) > 2 * SIDE:
        marks[_near(rows, _steps(profile, rows), len(marks))] |= np.uint8(Mark.STEP)
        marks[_near(rows, _edges(profile, rows), len(marks))] |= np.uint8(Mark.ALBEDO_EDGE)
    marks[~profile.valid] = 0
    return marks


def _steps(profile: StripeProfile, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """True (len(rows) − 1,) where the centre jumps from one line that has a stripe to the next."""
    centre, sigma = profile.centres[rows], profile.sigma[rows]
    apart = np.diff(rows)
    move = np.diff(centre)
    slope = _running_median(move / apart)
    limit = STEP_PX + STEP_WIDTHS * np.nanmedian(profile.width[rows]) + STEP_SIGMAS * np.hypot(sigma[1:], sigma[:-1])
    return np.abs(move - slope * apart) > np.where(apart <= LONGEST_GAP, limit, 0.0)


def _edges(profile: StripeProfile, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """True (len(rows) − 1,) where the stripe is much brighter on one side of a line than on the other."""
    bright = np.log(np.maximum(profile.amplitude[rows], 1e-3))
    sides = np.lib.stride_tricks.sliding_window_view(bright, SIDE)
    before, after = np.median(sides[: -SIDE - 1], axis=1), np.median(sides[SIDE + 1 :], axis=1)
    scatter = np.median(np.abs(np.diff(bright))) / 0.6745 / np.sqrt(2)
    change = np.zeros(len(rows) - 1)
    change[SIDE - 1 : SIDE - 1 + len(before)] = np.abs(after - before)
    return np.asarray(change > max(BRIGHTER, BRIGHTER_SCATTERS * float(scatter) / np.sqrt(SIDE)))


def _near(rows: NDArray[np.intp], jumps: NDArray[np.bool_], lines: int) -> NDArray[np.bool_]:
    """True (lines,) within NEAR of the jumps between `rows`."""
    near = np.zeros(lines + 2 * NEAR + 1, np.bool_)
    for first, last in zip(rows[:-1][jumps], rows[1:][jumps], strict=True):
        near[first + 1 : first + NEAR + 1] = True
        near[max(0, first - NEAR + 1) : first + 1] = True
        near[last : last + NEAR] = True
    return near[:lines]


def _running_median(values: Array) -> Array:
    size = 2 * SIDE + 1
    if len(values) < size:
        return np.full(len(values), np.median(values))
    padded = np.pad(values, SIDE, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, size), axis=1))


Image = NDArray[np.uint8]
Axis = Literal["rows", "columns"]


@dataclass(frozen=True)
class StripeSettings:
    """What the extraction may assume about camera and stripe; DN are the image's grey values.

    `read_noise_dn` holds the quantisation. `speckle_contrast` and `speckle_grain_px` None: measured in each picture.
    `dark_frames` is how many pictures the dark frame is the mean of.
    """

    least_peak_dn: float = 8.0
    read_noise_dn: float = 0.5
    gain_dn: float = 1 / 40  # variance per DN of signal: 1/(electrons per DN)
    speckle_contrast: float | None = None
    speckle_grain_px: float | None = None
    saturation_dn: int = 255
    width_range_px: tuple[float, float] = (0.45, 9.0)
    steps: int = 8
    dark_frames: int = 1


@dataclass(frozen=True)
class StripeProfile:
    """One stripe: arrays of length n, one entry per image row (axis "rows") or column; NaN where there is no stripe.

    `centres` and `sigma` (one standard deviation of the centre) in px, `amplitude` in DN (of the fitted peak, above the
    sensor's range in `saturated` rows), `width` the stripe's σ in px. `double` marks rows with a second peak of
    comparable energy: the one nearer to where the neighbours' stripe runs was taken, else the stronger. The deviations
    were made with `speckle`, None where it was assumed, for too few lines show any, or declared, and with `noise`: the
    variance of a pixel in DN², without photons and whole (`planes.pixel_noise`). `rival` (n,) is the height of
    the next best peak over the stripe's, `misfit` (n,) χ² over what is usual in the picture, and `learned` what the
    picture taught; all None where the picture is an ordinary one.
    """

    axis: Axis
    centres: Array
    sigma: Array
    amplitude: Array
    width: Array
    saturated: NDArray[np.bool_]
    double: NDArray[np.bool_]
    speckle: Speckle | None = None
    noise: tuple[float, float] | None = None
    rival: Array | None = None
    misfit: Array | None = None
    learned: Learned | None = None

    @property
    def rows(self) -> NDArray[np.intp]:
        """Indices of the image rows (columns) that have a stripe."""
        return np.flatnonzero(self.valid)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True (n,) where there is a stripe."""
        return np.isfinite(self.centres)

    @property
    def marks(self) -> NDArray[np.uint8]:
        """Why points may be off by more than they state, sums of `Mark` (n,)."""
        return marks_of(self)

    def pixels(self) -> Array:
        """Pixels (m, 2), x then y, of the m rows that have a stripe, in the order of `rows`."""
        rows = self.rows
        pair = (self.centres[rows], rows.astype(np.float64))
        return np.column_stack(pair if self.axis == "rows" else pair[::-1])
