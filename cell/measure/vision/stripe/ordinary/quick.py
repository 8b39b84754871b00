"""The stripe of ordinary pictures, grey and of 8 bits, by the compiled search and the fit of a Gaussian.

Says also, from a few of a picture's lines, whether it is an ordinary one; if not, `careful.py` has the word. Asked once
for each picture, or for the first of a stream's block. Which of two peaks in a line is the stripe only the neighbours
tell: those that show one peak say where it runs, else the peak with more energy stays, and the line is marked.
"""

from enum import Enum
from functools import cache, partial
from math import sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.vision.pictures import Dark, PictureRefused, Reason
from cell.measure.vision.stripe.ordinary import find, fit
from cell.measure.vision.stripe.ordinary.find import CENTRE, CORE, ENERGY, Floats, Shade
from cell.measure.vision.stripe.ordinary.find import WIDTH as PEAK_WIDTH
from cell.measure.vision.stripe.ordinary.fit import AMPLITUDE, CHI2, FISHER, FIT_CENTRE, LEVEL, SIGMA, SLOPE, WIDTH
from cell.measure.vision.stripe.ordinary.speckle import ASSUMED_GRAIN, correlation, measure_speckle, neighbours
from cell.measure.vision.stripe.planes import pixel_noise, trimmed_square
from cell.measure.vision.stripe.profile import Array, Axis, Image, StripeProfile, StripeSettings

BINS, WITHIN = 28, 3.5
"""Of the mean residual across the stripe, and how far out it goes, in widths."""
ASKED = 200
LEAST_ASKED = 30
PATTERN, SIGNIFICANT = 0.08, 3.0
"""A mean residual of this share of the noise's power, and so many times what chance makes, is another profile."""
WIDEST = 4.5
"""σ in px of the widest stripe that the quick search sees whole."""
HARDLY_ANY = 0.05
"""Share of the lines."""
BROKEN, REFUSED = 0.03, 0.06
"""Shares of the lines that jump away from both neighbours, and that show a peak which is no stripe."""
UNEVEN, BRIGHT_DN = 0.25, 25.0
"""Difference of the albedo on both sides of the stripe, and the light from which it can be seen."""
FAR_LAG, SAMPLED_LINES = 4, 8
TEXTURE_DN2, TEXTURE_RATIO = 1.0, 2.0
"""Variance of the background about straight lines, and that of distant pixels over that of near ones: texture."""


@compiled
def is_profile_gaussian(image: Image, dark: Shade, fitted: Array, start: Array) -> bool:
    """True when the mean residual of some fitted lines, registered at their centres, is no more than their noise."""
    lines, n = image.shape
    sums, squares, counts = np.zeros(BINS), np.zeros(BINS), np.zeros(BINS)
    known = 0
    for r in range(lines):
        known += np.isfinite(fitted[FIT_CENTRE, r]) and start[r, 0, CORE] == 0
    if known < LEAST_ASKED:
        return True
    every = max(1, known // ASKED)
    seen = 0
    for r in range(lines):
        centre = fitted[FIT_CENTRE, r]
        if not np.isfinite(centre) or start[r, 0, CORE] > 0:
            continue
        seen += 1
        if seen % every:
            continue
        width, amplitude = fitted[WIDTH, r], fitted[AMPLITUDE, r]
        origin = np.floor(centre + 0.5)
        first, last = int(np.ceil(centre - WITHIN * width)), int(np.floor(centre + WITHIN * width))
        for i in range(max(0, first), min(n - 1, last) + 1):
            z = (i - centre) / width
            shade = float(dark[r, i]) if len(dark) > 1 else 0.0
            mean = amplitude * np.exp(-0.5 * z * z) + fitted[LEVEL, r] + fitted[SLOPE, r] * (i - origin)
            off = image[r, i] - shade - mean
            k = min(BINS - 1, int((z + WITHIN) * BINS / (2 * WITHIN)))
            sums[k] += off
            squares[k] += off * off
            counts[k] += 1
    pattern, chance, used = 0.0, 0.0, 0
    for k in range(BINS):
        if counts[k] < 8:
            continue
        mean = sums[k] / counts[k]
        variance = max(squares[k] / counts[k] - mean * mean, 1e-3)
        pattern += mean * mean / variance
        chance += counts[k] * mean * mean / variance
        used += 1
    if used < BINS // 4:
        return True
    return not (pattern / used > PATTERN and chance / used > SIGNIFICANT * SIGNIFICANT)


def is_line_whole(fitted: Array, start: Array, found: NDArray[np.intp]) -> bool:
    """True when few lines with a peak are no stripe, and few stripes stand where neither neighbour has its."""
    apart, aside = np.diff(found), np.abs(np.diff(fitted[FIT_CENTRE, found]))
    near = (apart <= 3) & (aside <= 4.0 * apart + fitted[WIDTH, found[1:]])
    # A stripe that goes on at one side at least is no stray.
    broken = np.count_nonzero(~(np.append(False, near) | np.append(near, False)))
    refused = np.count_nonzero(start[:, 0, ENERGY] > 0) - len(found)
    return bool(refused <= REFUSED * len(start) and broken <= BROKEN * len(found) + 2)


def is_surface_even(dark: Shade, fitted: Array, found: NDArray[np.intp]) -> bool:
    """True when the picture without the laser shows no edges of the surface's albedo under the stripe, or is dark."""
    if len(dark) < fitted.shape[1]:
        return True
    centre, width = fitted[FIT_CENTRE, found], fitted[WIDTH, found]
    left, right = (centre - 1.5 * width).astype(np.intp), (centre + 1.5 * width + 1).astype(np.intp)
    inside = (left >= 0) & (right < dark.shape[1])
    one, other = (dark[found[inside], side[inside]].astype(np.float64) for side in (left, right))
    uneven = np.count_nonzero(np.abs(one - other) > UNEVEN * 0.5 * (one + other))
    return bool(np.sum(0.5 * (one + other)) < BRIGHT_DN * len(one) or uneven <= BROKEN * len(one))


def has_rivals(fitted: Array, start: Array, found: NDArray[np.intp]) -> bool:
    """True when centres jump and many lines have a second peak: the wrong one may have been taken."""
    aside = np.abs(np.diff(fitted[FIT_CENTRE, found]))
    jumps = (np.diff(found) == 1) & (aside > 6.0 + 2 * fitted[WIDTH, found[1:]])
    return bool(jumps.any() and np.count_nonzero(start[:, 1, ENERGY] > 0) > REFUSED * len(found))


@compiled
def is_textured(image: Image) -> bool:
    """True when pixels of the background differ more from those some px away than from the next ones."""
    lines, n = image.shape
    near = np.zeros(1024, np.int64)
    far = np.zeros(1024, np.int64)
    total = 0
    for r in range(lines // (2 * SAMPLED_LINES), lines, max(1, lines // SAMPLED_LINES)):
        for i in range(FAR_LAG, n - FAR_LAG, 3):
            here = 2 * np.int64(image[r, i])
            near[abs(np.int64(image[r, i - 1]) + np.int64(image[r, i + 1]) - here)] += 1
            far[abs(np.int64(image[r, i - FAR_LAG]) + np.int64(image[r, i + FAR_LAG]) - here)] += 1
            total += 1
    distant, next_ = trimmed_square(far, total), trimmed_square(near, total)
    return bool(distant > 6 * TEXTURE_DN2 and distant > TEXTURE_RATIO * next_)


ASSUMED_CONTRAST = 0.15
"""Of the speckle where a picture shows too few lines to measure it."""
SPECKLE_PAIRS = 128
NO_LAGS = np.zeros(0, np.float32)
# Propagation is linear in the speckle's contrast C; what it leaves out grows as C⁴, and was taken from simulation.
SECOND_ORDER = 3.0
BLINDED_SHARE = 0.6
MISTAKABLE = 0.02
"""Share of the lines with a second peak from which the quick search may have followed the wrong one."""


DOUBLE, RIVAL = 0.5, 0.15
"""Energy of the weaker peak over that of the stronger from which a line is marked as double, or asks its neighbours."""
# Lines on either side that are asked where the stripe runs, how many of them at most, and how near it has to be.
BESIDE, MOST_ASKED, NEAR = 30, 7, 4.0
SMOOTHED = 7
# A misfit that noise makes once in some hundred lines; beyond it, the deviation grows with the misfit.
MISFIT_SIGMAS = 3.0


class QuickVerdict(Enum):
    """What the quick way says of its own result."""

    ORDINARY = "nothing more to be said"
    UNMISTAKABLE = "no other peaks than the stripe's, but it is wide, broken, textured or no Gaussian"
    NOT_ORDINARY = "to be looked at more closely"


def read_quickly(
    image: Image, dark: Dark | None, axis: Axis, settings: StripeSettings, like: StripeProfile | None
) -> tuple[StripeProfile, QuickVerdict]:
    """The profile by search and fit of a Gaussian, and whether this is enough for the picture."""
    work, shade = _lines(image, axis), _lines(dark, axis)
    noise, speckle = (None, None) if like is None else (like.noise, like.speckle)
    noise2, whole = noise or pixel_noise(work, settings.gain_dn, settings.read_noise_dn**2)
    gain, frames = settings.gain_dn, settings.dark_frames
    seen, of_dark = work, (0.0, 0.0)
    if dark is not None:
        seen, of_dark = _above(work, shade), (noise2 / frames, gain * (1 + 1 / frames))
    least = max(settings.least_peak_dn, 5 * sqrt(whole))
    start = np.zeros((len(work), find.CANDIDATES, find.START))
    cut, cut_at = np.empty((len(work), find.CUT), np.uint8), np.full(len(work), find.NOWHERE)
    several = find.find_lines(
        work, seen, shade, saturation=settings.saturation_dn, least_peak=least, start=start, cut=cut, cut_at=cut_at
    )
    double = choose(start) if several else np.zeros(len(start), np.bool_)
    low, high = settings.width_range_px
    found, widths = survey(start, low, high)
    _refuse_blinded(image, start, found, settings.saturation_dn)
    fitted = np.full((fit.FITTED, len(work)), np.nan)

    def run(which: NDArray[np.intp], contrast: float, rho: Floats) -> None:
        fit.fit_lines(
            work, cut, cut_at, dark=shade, start=start, widths=widths, log_widths=np.log(widths), which=which,
            saturation=settings.saturation_dn,
            noise=(noise2, gain, contrast), dark_noise=of_dark, rho=rho, steps=settings.steps, out=fitted,
        )  # fmt: skip

    contrast, grain = settings.speckle_contrast, settings.speckle_grain_px
    if contrast is None or (contrast > 0 and grain is None):
        if speckle is None:
            pairs = neighbours(start, double, SPECKLE_PAIRS)
            run(np.concatenate([pairs, pairs + 1]), ASSUMED_CONTRAST, NO_LAGS)
            speckle = measure_speckle(
                work, shade, pairs, widths=widths, fitted=fitted, noise2=noise2, gain=gain, contrast=ASSUMED_CONTRAST
            )
        seen_contrast, seen_grain, widening = speckle or (ASSUMED_CONTRAST, ASSUMED_GRAIN, 1.0)
        widths = np.minimum(np.maximum(widths * widening, low), high)
        contrast = seen_contrast if contrast is None else contrast
        grain = seen_grain if grain is None else grain
    run(found, contrast, _lags(contrast, grain))
    saturated, excess = np.empty(len(work), np.bool_), 1 + SECOND_ORDER * contrast**2
    believe(
        fitted, start, work.shape[1], low, high, least=0.5 * least, excess=excess, double=double, saturated=saturated
    )
    centres, sigma, amplitude, width = (fitted[k] for k in (fit.FIT_CENTRE, fit.SIGMA, fit.AMPLITUDE, fit.WIDTH))
    profile = StripeProfile(
        axis, centres, sigma, amplitude=amplitude, width=width, saturated=saturated, double=double, speckle=speckle,
        noise=(noise2, whole),
    )  # fmt: skip
    if _is_like(profile, like):
        return profile, QuickVerdict.ORDINARY
    ordinary = _is_ordinary(fitted, start, work, shade=shade, seen=seen, several=several)
    return profile, QuickVerdict.ORDINARY if ordinary else _not_ordinary(profile, start)


def _is_ordinary(fitted: Array, start: Array, work: Image, *, shade: Image, seen: Image, several: bool) -> bool:
    """Whether the stripe is whole, narrow, unsaturated, Gaussian, the only one, and on an even, plain surface.

    One that is wider than the search's window takes, or hardly there, is not; what flanks look like beside a saturated
    core is seldom a Gaussian.
    """
    found = np.flatnonzero(np.isfinite(fitted[FIT_CENTRE]))
    wide, hidden = fitted[WIDTH, found] > WIDEST, start[found, 0, CORE] > 1
    return bool(
        is_line_whole(fitted, start, found)
        and len(found) >= HARDLY_ANY * len(start)
        and 2 * np.count_nonzero(wide) < len(found)
        and 2 * np.count_nonzero(hidden) <= len(found)
        and is_profile_gaussian(work, shade, fitted, start)
        and not (several and has_rivals(fitted, start, found))
        and is_surface_even(shade, fitted, found)
        and not is_textured(seen)
    )


def _lags(contrast: float, grain: float | None) -> NDArray[np.float32]:
    return correlation(grain) if contrast > 0 and grain else NO_LAGS


def _is_like(profile: StripeProfile, like: StripeProfile | None) -> bool:
    """Whether it is to be taken as the one before it was: that one was measured, or both show hardly a line."""
    if like is None:
        return False
    return like.speckle is not None or max(profile.valid.mean(), like.valid.mean()) < HARDLY_ANY


def _not_ordinary(profile: StripeProfile, start: Array) -> QuickVerdict:
    """By the share of its lines that have a second peak, which the search may have followed."""
    second = float(np.mean(start[profile.valid, 1, find.ENERGY] > 0)) if profile.valid.any() else 1.0
    return QuickVerdict.UNMISTAKABLE if second < MISTAKABLE else QuickVerdict.NOT_ORDINARY


def _lines(part: Dark | None, axis: Axis) -> Any:
    """A picture with the stripe's lines as its rows; a picture of one pixel stands for no dark frame."""
    if part is None:
        return np.zeros((1, 1), np.uint8)
    if part.dtype not in (np.uint8, np.float32):
        part = part.astype(np.float32)
    return np.ascontiguousarray(part) if axis == "rows" else cv2.transpose(part)


def _above(work: Image, shade: Shade) -> Image:
    """What lies above the dark frame, for the search; where both are saturated nothing does."""
    flat = shade if shade.dtype == np.uint8 else np.clip(np.rint(shade), 0, 255).astype(np.uint8)
    return np.asarray(cv2.subtract(work, flat), dtype=np.uint8)


def _refuse_blinded(image: Image, start: Array, found: NDArray[np.intp], saturation: int) -> None:
    """Refuse a picture that is mostly white; looked at closely only where hardly a line shows a stripe."""
    if len(found) > 0.2 * len(start):
        return
    refuse_white(image >= saturation)


def refuse_white(saturated: NDArray[np.bool_]) -> None:
    """Refuse a picture most of whose pixels are at the end of their range."""
    share = float(np.mean(saturated))
    if share > BLINDED_SHARE:
        raise PictureRefused(
            Reason.SATURATED,
            f"the stripe's picture is saturated: {share:.0%} of its pixels are at the end of their range, allowed "
            f"{BLINDED_SHARE:.0%}; shorten the exposure or keep the ambient light off",
        )


def choose(start: Array) -> NDArray[np.bool_]:
    """True (lines,) where two peaks compete; `start` (lines, 2, …) is put in order, the chosen one first."""
    energy = start[:, :, ENERGY]
    rival = energy[:, 1] > RIVAL * energy[:, 0]
    double: NDArray[np.bool_] = energy[:, 1] > DOUBLE * energy[:, 0]
    if not rival.any():
        return double
    alone = np.flatnonzero((energy[:, 0] > 0) & ~rival)
    for line in np.flatnonzero(rival):
        here = np.searchsorted(alone, line)
        sides = (alone[max(0, here - MOST_ASKED) : here], alone[here : here + MOST_ASKED])
        asked = np.concatenate([side[np.abs(side - line) <= BESIDE] for side in sides])
        if len(asked) < 3:
            continue
        slope, middle = _line_through(asked - line, start[asked, 0, CENTRE])
        away = np.abs(start[line, :, CENTRE] - middle)
        tolerance = NEAR + 0.5 * abs(slope) + start[line, 0, PEAK_WIDTH]
        if away[1] < tolerance < away[0]:
            start[line] = start[line, ::-1]
            double[line] = True
    return double


def _line_through(x: Array, y: Array) -> tuple[float, float]:
    """Slope and value at 0 of a line that one bad point in four does not move: medians of slopes and of values."""
    i, j = _pairs(len(x))
    slope = float(np.median((y[j] - y[i]) / (x[j] - x[i])))
    return slope, float(np.median(y - slope * x))


_pairs = cache(partial(np.triu_indices, k=1))
"""Numbers of the first and of the second of each pair among so many."""


@compiled
def survey(start: Array, low: float, high: float) -> tuple[NDArray[np.int64], Array]:
    """What the lines say together: those found (m,) and how wide the stripe is about each line (lines,).

    The width in px is the running mean over 15 lines of the start widths within low … high, which are counts of pixels
    and coarse one by one.
    """
    lines = len(start)
    found = np.empty(lines, np.int64)
    # Sums over the lines before each.
    totals, counts = np.zeros(lines + 1), np.zeros(lines + 1, np.int64)
    for r in range(lines):
        totals[r + 1], counts[r + 1] = totals[r], counts[r]
        if start[r, 0, ENERGY] > 0:
            totals[r + 1] += min(max(start[r, 0, PEAK_WIDTH], low), high)
            found[counts[r]] = r
            counts[r + 1] += 1
    widths = np.empty(lines)
    overall = totals[lines] / counts[lines] if counts[lines] > 0 else min(max(1.0, low), high)
    for r in range(lines):
        first, end = max(0, r - SMOOTHED), min(lines, r + SMOOTHED + 1)
        here = counts[end] - counts[first]
        widths[r] = (totals[end] - totals[first]) / here if here > 0 else overall
    return found[: counts[lines]], widths


@compiled
def believe(
    fitted: Array, start: Array, length: int, narrowest: float, widest: float, least: float, excess: float,
    double: NDArray[np.bool_], saturated: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Put NaN into the lines of `fitted` (FITTED, lines) that are no stripe of a picture of `length` px a line.

    A stripe has a width in px within the range, an amplitude above `least` DN, its whole peak in the picture, and its
    centre near the start's. The variance of the others grows by `excess` and with their misfit. `double` and
    `saturated` (lines,) are True of no line that is none; the latter is told here.
    """
    for r in range(fitted.shape[1]):
        centre, width, fisher = fitted[FIT_CENTRE, r], fitted[WIDTH, r], fitted[FISHER, r]
        keep = width > narrowest and width < widest and fitted[AMPLITUDE, r] > least
        keep = keep and centre > 1.5 * width and centre < length - 1 - 1.5 * width
        keep = keep and abs(centre - start[r, 0, CENTRE]) < max(3.0, 2 * width)
        if keep and fisher < max(1.0, 0.5 * width):
            pixels = 8 * width + 2
            allowed = 1 + MISFIT_SIGMAS * np.sqrt(2 / pixels)
            fitted[SIGMA, r] *= np.sqrt(excess * max(1.0, fitted[CHI2, r] / allowed))
            saturated[r] = start[r, 0, CORE] > 0
        else:
            fitted[FIT_CENTRE, r] = fitted[SIGMA, r] = fitted[AMPLITUDE, r] = fitted[WIDTH, r] = np.nan
            double[r] = saturated[r] = False
