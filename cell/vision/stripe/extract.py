"""Sub-pixel centres of the laser stripe, one per image row (or column), with an honest standard deviation each.

`extract` is the way in, to all methods; weighted maximum likelihood is the default and the one that attains the bound
(docs/theory.md, section 5). What a centre means in space is the business of the geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import sqrt
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cell import compiled
from cell.vision.pictures import PictureRefused, Reason
from cell.vision.stripe import find as find
from cell.vision.stripe import fit as fit
from cell.vision.stripe import search as stripe_search
from cell.vision.stripe import without_compiler as stripe_numpy
from cell.vision.stripe.belief import believe
from cell.vision.stripe.methods import METHODS
from cell.vision.stripe.noise import pixel_noise
from cell.vision.stripe.rivals import choose, survey
from cell.vision.stripe.speckle import ASSUMED_GRAIN, Speckle, correlation, measure_speckle, neighbours

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Axis = Literal["rows", "columns"]

ASSUMED_CONTRAST = 0.15
"""Of the speckle where a picture shows too few lines to measure it."""
SPECKLE_PAIRS = 128
NO_LAGS = np.zeros(0, np.float32)
# Propagation is linear in the speckle's contrast C; what it leaves out grows as C⁴, and was taken from simulation.
SECOND_ORDER = 3.0
BLINDED_SHARE = 0.6


class Method(StrEnum):
    """How a centre is had from the pixels around the peak."""

    MAXIMUM_LIKELIHOOD = "maximum_likelihood"
    EXTREME_VALUE = "extreme_value"
    CENTRE_OF_GRAVITY = "centre_of_gravity"
    GAUSSIAN_3_POINT = "gaussian_3_point"
    GAUSSIAN_LEAST_SQUARES = "gaussian_least_squares"
    STEGER = "steger"


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
    variance of a pixel in DN², without photons and whole (`stripe_noise.pixel_noise`).
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

    @property
    def rows(self) -> NDArray[np.intp]:
        """Indices of the image rows (columns) that have a stripe."""
        return np.flatnonzero(self.valid)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True (n,) where there is a stripe."""
        return np.isfinite(self.centres)

    def pixels(self) -> Array:
        """Pixels (m, 2), x then y, of the m rows that have a stripe, in the order of `rows`."""
        rows = self.rows
        pair = (self.centres[rows], rows.astype(np.float64))
        return np.column_stack(pair if self.axis == "rows" else pair[::-1])


def extract(
    image: Image,
    dark: NDArray[np.floating] | NDArray[np.uint8] | None = None,
    axis: Axis = "rows",
    settings: StripeSettings | None = None,
    *,
    method: Method | str = Method.MAXIMUM_LIKELIHOOD,
    engine: Literal["auto", "compiled", "numpy"] = "auto",
    like: StripeProfile | None = None,
) -> StripeProfile:
    """Stripe centres of an 8-bit image (h, w), one per row (or per column with axis "columns").

    `dark` (h, w) is a frame of the same view without the laser and is subtracted; its noise counts. `engine` "numpy"
    does without the compiler, as "auto" does where there is none. `like` is the profile of an earlier picture of the
    same scene, whose noise and speckle hold for this one as far as it has them; None: they are measured, where the
    settings do not declare them. Raises ValueError for an image of another type, a dark frame of another size or an
    unknown method, `PictureRefused` for a picture that is blinded.
    """
    settings = settings or StripeSettings()
    method = Method(method)
    _check(image, dark)
    if engine == "compiled" and not compiled.AVAILABLE:
        raise ValueError('engine "compiled": numba is missing or switched off here; take "numpy" or "auto"')
    quick = compiled.AVAILABLE and engine != "numpy"
    work, shade = _lines(image, axis), _lines(dark, axis)
    seen = work if dark is None else _above(work, shade)
    noise = like.noise if like is not None else None
    noise2, whole = noise or pixel_noise(work, settings.gain_dn, settings.read_noise_dn**2)
    least = max(settings.least_peak_dn, 5 * sqrt(whole))
    start = np.zeros((len(work), find.CANDIDATES, find.START))
    cut, cut_at = np.empty((len(work), find.CUT), np.uint8), np.full(len(work), find.NOWHERE)
    search = (stripe_search if quick else stripe_numpy).find_lines
    several = search(work, seen, shade, settings.saturation_dn, least, start, cut, cut_at)
    double = choose(start) if several else np.zeros(len(start), np.bool_)
    low, high = settings.width_range_px
    found, widths = survey(start, low, high)
    _refuse_blinded(image, start, found, settings.saturation_dn)
    fitted = np.full((fit.FITTED, len(work)), np.nan)
    gain, frames = settings.gain_dn, settings.dark_frames
    of_dark = (0.0, 0.0) if dark is None else (noise2 / frames, gain * (1 + 1 / frames))

    def run(which: NDArray[np.intp], contrast: float, rho: Any) -> None:
        (fit if quick else stripe_numpy).fit_lines(
            work, cut, cut_at, shade, start, widths, np.log(widths), which, settings.saturation_dn,
            (noise2, gain, contrast), of_dark, rho, settings.steps, fitted,
        )  # fmt: skip

    speckle = like.speckle if like is not None else None
    contrast, grain = settings.speckle_contrast, settings.speckle_grain_px
    if contrast is None or (contrast > 0 and grain is None):
        if speckle is None:
            pairs = neighbours(start, double, SPECKLE_PAIRS)
            run(np.concatenate([pairs, pairs + 1]), ASSUMED_CONTRAST, NO_LAGS)
            speckle = measure_speckle(work, shade, pairs, widths, fitted, noise2, gain, ASSUMED_CONTRAST)
        seen_contrast, seen_grain, widening = speckle or (ASSUMED_CONTRAST, ASSUMED_GRAIN, 1.0)
        widths = np.minimum(np.maximum(widths * widening, low), high)
        contrast = seen_contrast if contrast is None else contrast
        grain = seen_grain if grain is None else grain
    rho = correlation(grain) if contrast > 0 and grain else NO_LAGS
    if method is Method.MAXIMUM_LIKELIHOOD:
        run(found, contrast, rho)
    else:
        variance = noise2, gain, frames if dark is not None else 0
        fitted = METHODS[method](work, shade, start, found, variance, (contrast, rho), settings)
    saturated = np.empty(len(work), np.bool_)
    excess = 1 + SECOND_ORDER * contrast**2
    believe(fitted, start, work.shape[1], low, high, 0.5 * least, excess, double, saturated)
    centres, sigma, amplitude, width = (fitted[k] for k in (fit.FIT_CENTRE, fit.SIGMA, fit.AMPLITUDE, fit.WIDTH))
    return StripeProfile(axis, centres, sigma, amplitude, width, saturated, double, speckle, (noise2, whole))


def _check(image: Image, dark: Any) -> None:
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"the stripe needs a grey 8-bit image, not {image.dtype} of shape {image.shape}")
    if dark is not None and dark.shape != image.shape:
        raise ValueError(f"the dark frame is {dark.shape}, the image {image.shape}: take both with the same camera")
    if min(image.shape) < 32:
        raise ValueError(f"the image is {image.shape[1]}×{image.shape[0]} px; at least 32×32 are needed")


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
    share = float(np.mean(image >= saturation))
    if share > BLINDED_SHARE:
        raise PictureRefused(
            Reason.SATURATED,
            f"the stripe's picture is saturated: {share:.0%} of it at {saturation} DN or more, allowed "
            f"{BLINDED_SHARE:.0%}; shorten the exposure or keep the ambient light off",
        )
