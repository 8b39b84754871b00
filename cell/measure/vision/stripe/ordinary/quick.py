"""The stripe of ordinary pictures, grey and of 8 bits, by the compiled search and the fit of a Gaussian.

Says also whether the picture is an ordinary one; if not, `careful.py` has the word.
"""

from __future__ import annotations

from enum import Enum
from math import sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.pictures import PictureRefused, Reason
from cell.measure.vision.stripe.careful.competing_peaks import choose, survey
from cell.measure.vision.stripe.careful.speckle import ASSUMED_GRAIN, correlation, measure_speckle, neighbours
from cell.measure.vision.stripe.careful.validation import believe
from cell.measure.vision.stripe.noise import pixel_noise
from cell.measure.vision.stripe.ordinary import find, fit
from cell.measure.vision.stripe.ordinary import search as stripe_search
from cell.measure.vision.stripe.ordinary.conditions import (
    HARDLY_ANY,
    has_rivals,
    is_line_whole,
    is_profile_gaussian,
    is_saturated,
    is_surface_even,
    is_textured,
    is_too_wide,
)
from cell.measure.vision.stripe.profile import Array, Axis, Image, StripeProfile, StripeSettings

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
    image: Image, dark: Any, axis: Axis, settings: StripeSettings, like: StripeProfile | None
) -> tuple[StripeProfile, QuickVerdict]:
    """The profile by search and fit of a Gaussian, and whether this is enough for the picture."""
    work, shade = _lines(image, axis), _lines(dark, axis)
    seen = work if dark is None else _above(work, shade)
    noise = like.noise if like is not None else None
    noise2, whole = noise or pixel_noise(work, settings.gain_dn, settings.read_noise_dn**2)
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
    gain, frames = settings.gain_dn, settings.dark_frames
    of_dark = (0.0, 0.0) if dark is None else (noise2 / frames, gain * (1 + 1 / frames))

    def run(which: NDArray[np.intp], contrast: float, rho: Any) -> None:
        fit.fit_lines(
            work, cut, cut_at, dark=shade, start=start, widths=widths, log_widths=np.log(widths), which=which,
            saturation=settings.saturation_dn,
            noise=(noise2, gain, contrast), dark_noise=of_dark, rho=rho, steps=settings.steps, out=fitted,
        )  # fmt: skip

    speckle = like.speckle if like is not None else None
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
    rho = correlation(grain) if contrast > 0 and grain else NO_LAGS
    run(found, contrast, rho)
    saturated = np.empty(len(work), np.bool_)
    excess = 1 + SECOND_ORDER * contrast**2
    believe(
        fitted, start, work.shape[1], low, high, least=0.5 * least, excess=excess, double=double, saturated=saturated
    )
    centres, sigma, amplitude, width = (fitted[k] for k in (fit.FIT_CENTRE, fit.SIGMA, fit.AMPLITUDE, fit.WIDTH))
    profile = StripeProfile(
        axis,
        centres,
        sigma,
        amplitude=amplitude,
        width=width,
        saturated=saturated,
        double=double,
        speckle=speckle,
        noise=(noise2, whole),
    )
    if like is not None and like.speckle is not None:
        return profile, QuickVerdict.ORDINARY
    if like is not None and max(profile.valid.mean(), like.valid.mean()) < HARDLY_ANY:
        return profile, QuickVerdict.ORDINARY
    ordinary = (
        is_line_whole(fitted, start)
        and not is_too_wide(fitted, start)
        and not is_saturated(fitted, start)
        and is_profile_gaussian(work, shade, fitted, start)
        and not (several and has_rivals(fitted, start))
        and is_surface_even(shade, fitted)
        and not is_textured(seen)
    )
    if ordinary:
        return profile, QuickVerdict.ORDINARY
    second = float(np.mean(start[profile.valid, 1, find.ENERGY] > 0)) if profile.valid.any() else 1.0
    return profile, QuickVerdict.UNMISTAKABLE if second < MISTAKABLE else QuickVerdict.NOT_ORDINARY


def _lines(part: Any, axis: Axis) -> Any:
    """A picture with the stripe's lines as its rows; a picture of one pixel stands for no dark frame."""
    if part is None:
        return np.zeros((1, 1), np.uint8)
    if part.dtype not in (np.uint8, np.float32):
        part = part.astype(np.float32)
    return np.ascontiguousarray(part) if axis == "rows" else cv2.transpose(part)


def _above(work: Image, shade: Any) -> Image:
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
