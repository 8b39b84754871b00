"""The stripe of ordinary pictures, grey and of 8 bits, by the compiled search and the fit of a Gaussian.

Says also whether the picture is an ordinary one; if not, `careful.py` has the word.

Whether a picture is an ordinary one, for which the quick search and the fit of a Gaussian say all there is to say.

Asked once for each picture, or for the first of a stream's block, of a few of its lines. Where the answer is no, the
stripe is read carefully (`careful.py`)."""

from __future__ import annotations

from enum import Enum
from math import sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.vision.pictures import Dark, PictureRefused, Reason
from cell.measure.vision.stripe.careful.careful import believe
from cell.measure.vision.stripe.careful.follow import choose, survey
from cell.measure.vision.stripe.careful.speckle import ASSUMED_GRAIN, correlation, measure_speckle, neighbours
from cell.measure.vision.stripe.ordinary import find, fit
from cell.measure.vision.stripe.ordinary import search as stripe_search
from cell.measure.vision.stripe.ordinary.find import CORE, ENERGY, Floats, Shade, Whole
from cell.measure.vision.stripe.ordinary.fit import AMPLITUDE, FIT_CENTRE, LEVEL, SLOPE, WIDTH
from cell.measure.vision.stripe.planes import pixel_noise
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
    pattern, power, chance, used = 0.0, 0.0, 0.0, 0
    for k in range(BINS):
        if counts[k] < 8:
            continue
        mean = sums[k] / counts[k]
        variance = max(squares[k] / counts[k] - mean * mean, 1e-3)
        pattern += mean * mean / variance
        chance += counts[k] * mean * mean / variance
        power += 1.0
        used += 1
    if used < BINS // 4:
        return True
    return not (pattern / used > PATTERN and chance / used > SIGNIFICANT * SIGNIFICANT)


@compiled
def is_line_whole(fitted: Array, start: Array) -> bool:
    """True when few lines with a peak are no stripe, and few stripes stand where neither neighbour has its."""
    lines = fitted.shape[1]
    peaks, found, broken = 0, 0, 0
    before, joined = -1, False
    for r in range(lines):
        peaks += start[r, 0, ENERGY] > 0
        if not np.isfinite(fitted[FIT_CENTRE, r]):
            continue
        found += 1
        # A stripe that goes on at one side at least is no stray.
        near = before >= 0 and r - before <= 3
        near = near and abs(fitted[FIT_CENTRE, r] - fitted[FIT_CENTRE, before]) <= 4.0 * (r - before) + fitted[WIDTH, r]
        if before >= 0 and not near and not joined:
            broken += 1
        joined = near
        before = r
    if before >= 0 and not joined:
        broken += 1
    return peaks - found <= REFUSED * lines and broken <= BROKEN * found + 2


@compiled
def is_too_wide(fitted: Array, start: Array) -> bool:
    """True when the stripes that were found are wider than the search's window takes, or hardly any was."""
    found, wide = 0, 0
    for r in range(fitted.shape[1]):
        if np.isfinite(fitted[FIT_CENTRE, r]):
            found += 1
            wide += fitted[WIDTH, r] > WIDEST
    return 2 * wide >= found or found < HARDLY_ANY * fitted.shape[1]


@compiled
def is_saturated(fitted: Array, start: Array) -> bool:
    """True when the cores of most stripes are saturated: what flanks look like is seldom a Gaussian."""
    found, hidden = 0, 0
    for r in range(fitted.shape[1]):
        if np.isfinite(fitted[FIT_CENTRE, r]):
            found += 1
            hidden += start[r, 0, CORE] > 1
    return 2 * hidden > found


@compiled
def is_surface_even(dark: Shade, fitted: Array) -> bool:
    """True when the picture without the laser shows no edges of the surface's albedo under the stripe, or is dark."""
    found, uneven, total = 0, 0, 0.0
    n = dark.shape[1]
    if len(dark) < fitted.shape[1]:
        return True
    for r in range(fitted.shape[1]):
        centre, width = fitted[FIT_CENTRE, r], fitted[WIDTH, r]
        if not np.isfinite(centre):
            continue
        left, right = int(centre - 1.5 * width), int(centre + 1.5 * width + 1)
        if left < 0 or right >= n:
            continue
        one, other = float(dark[r, left]), float(dark[r, right])
        found += 1
        total += 0.5 * (one + other)
        uneven += abs(one - other) > UNEVEN * 0.5 * (one + other)
    return total < BRIGHT_DN * found or uneven <= BROKEN * found


@compiled
def has_rivals(fitted: Array, start: Array) -> bool:
    """True when centres jump and many lines have a second peak: the wrong one may have been taken."""
    rivals, found, jumps, before = 0, 0, 0, -1
    for r in range(fitted.shape[1]):
        rivals += start[r, 1, ENERGY] > 0
        if not np.isfinite(fitted[FIT_CENTRE, r]):
            continue
        found += 1
        aside = abs(fitted[FIT_CENTRE, r] - fitted[FIT_CENTRE, before]) if before >= 0 else 0.0
        jumps += before == r - 1 and aside > 6.0 + 2 * fitted[WIDTH, r]
        before = r
    return jumps > 0 and rivals > REFUSED * found


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
    distant, next_ = _trimmed(far, total), _trimmed(near, total)
    return bool(distant > 6 * TEXTURE_DN2 and distant > TEXTURE_RATIO * next_)


@compiled
def _trimmed(counts: Whole, total: int) -> float:
    """Mean square of what was counted, without what is far beyond its median."""
    median, below = 0, int(counts[0])
    while 2 * below < total:
        median += 1
        below += int(counts[median])
    kept, squares = 0, 0.0
    for size in range(min(len(counts), 4 * (median + 1) + 1)):
        kept += counts[size]
        squares += float(counts[size]) * size * size
    return squares / max(kept, 1)


ASSUMED_CONTRAST = 0.15
"""Of the speckle where a picture shows too few lines to measure it."""
SPECKLE_PAIRS = 128
NO_LAGS = np.zeros(0, np.float32)
# Propagation is linear in the speckle's contrast C; what it leaves out grows as C⁴, and was taken from simulation.
SECOND_ORDER = 3.0
BLINDED_SHARE = 0.6
MISTAKABLE = 0.02
"""Share of the lines with a second peak from which the quick search may have followed the wrong one."""


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
    several = stripe_search.find_lines(
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
    """Whether the stripe is whole, narrow, unsaturated, Gaussian, the only one, and on an even, plain surface."""
    return (
        is_line_whole(fitted, start)
        and not is_too_wide(fitted, start)
        and not is_saturated(fitted, start)
        and is_profile_gaussian(work, shade, fitted, start)
        and not (several and has_rivals(fitted, start))
        and is_surface_even(shade, fitted)
        and not is_textured(seen)
    )


def _lags(contrast: float, grain: float | None) -> NDArray[np.float32]:
    """The speckle's correlation by lag; none where there is no speckle."""
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
