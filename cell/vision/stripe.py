"""Sub-pixel centres of the laser stripe, one per image row (or column), with an honest standard deviation each.

`extract` is the way in, to all methods; weighted maximum likelihood is the default and the one that attains the bound
(theory sheet, part 3). What a centre means in space is the business of the geometry.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.vision import compiled, stripe_numpy
from cell.vision import stripe_find as find
from cell.vision import stripe_fit as fit
from cell.vision.pictures import PictureRefused, Reason
from cell.vision.stripe_methods import METHODS
from cell.vision.stripe_noise import pixel_noise
from cell.vision.stripe_rivals import choose, smooth_widths
from cell.vision.stripe_speckle import ASSUMED_GRAIN, correlation, measure_speckle

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
# A misfit that noise makes once in some hundred lines; beyond it, the deviation grows with the misfit.
MISFIT_SIGMAS = 3.0


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
    comparable energy: the one nearer to where the neighbours' stripe runs was taken, else the stronger.
    """

    axis: Axis
    centres: Array
    sigma: Array
    amplitude: Array
    width: Array
    saturated: NDArray[np.bool_]
    double: NDArray[np.bool_]

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
) -> StripeProfile:
    """Stripe centres of an 8-bit image (h, w), one per row (or per column with axis "columns").

    `dark` (h, w) is a frame of the same view without the laser and is subtracted; its noise counts. `engine` "numpy"
    does without the compiler, as "auto" does where there is none. Raises ValueError for an image of another type, a
    dark frame of another size or an unknown method, `PictureRefused` for a picture that is blinded.
    """
    settings = settings or StripeSettings()
    method = Method(method)
    _check(image, dark)
    if engine == "compiled" and not compiled.AVAILABLE:
        raise ValueError('engine "compiled": numba is missing or switched off here; take "numpy" or "auto"')
    quick = compiled.AVAILABLE and engine != "numpy"
    work, shade = (_lines(part, axis) for part in (image, dark))
    seen = work if dark is None else _above(work, shade)
    noise2, whole = pixel_noise(work, settings.gain_dn, settings.read_noise_dn**2)
    least = max(settings.least_peak_dn, 5 * np.sqrt(whole))
    start = np.zeros((len(work), find.CANDIDATES, find.START))
    finder = find.find_lines if quick else stripe_numpy.find_lines
    finder(work, seen, shade, dark is not None, settings.saturation_dn, least, 0, len(work), start)
    found = np.flatnonzero(start[:, 0, find.ENERGY] > 0)
    _refuse_blinded(image, start, found, settings.saturation_dn)
    double = choose(start)
    noise = _Noise(noise2, settings, dark is not None)
    fitted = np.full((fit.FITTED, len(work)), np.nan)
    fitter = fit.fit_lines if quick else stripe_numpy.fit_lines
    widths = smooth_widths(start, settings.width_range_px)

    def run(which: NDArray[np.intp], widths: Array, contrast: float, rho: Any) -> None:
        fitter(
            work, shade, dark is not None, start, widths, which, settings.saturation_dn, noise.pixel, settings.gain_dn,
            contrast, rho, *noise.of_dark, settings.steps, fitted,
        )  # fmt: skip

    contrast, grain = settings.speckle_contrast, settings.speckle_grain_px
    if contrast is None or (contrast > 0 and grain is None):
        clear = (start[:, 0, find.ENERGY] > 0) & (start[:, 0, find.CORE] == 0) & ~double
        pairs = np.flatnonzero(clear[:-1] & clear[1:])
        pairs = pairs[:: max(1, len(pairs) // SPECKLE_PAIRS)]
        sample = np.union1d(pairs, pairs + 1)
        run(sample, widths, ASSUMED_CONTRAST, NO_LAGS)
        measured = measure_speckle(
            work, shade, dark is not None, pairs, fitted, noise.pixel, settings.gain_dn, ASSUMED_CONTRAST
        )
        measured = measured or (ASSUMED_CONTRAST, ASSUMED_GRAIN)
        contrast = measured[0] if contrast is None else contrast
        grain = measured[1] if grain is None else grain
        if len(sample):
            # Peaks are chosen for being bright, so that speckle makes their start widths too small.
            ratio = np.nanmedian(fitted[fit.WIDTH, sample] / widths[sample])
            if np.isfinite(ratio):
                widths = np.clip(widths * np.clip(ratio, 0.5, 2.0), *settings.width_range_px)
    rho = correlation(grain) if contrast > 0 and grain else NO_LAGS
    if method is Method.MAXIMUM_LIKELIHOOD:
        run(found, widths, contrast, rho)
    else:
        frames = settings.dark_frames if dark is not None else 0
        variance = noise.pixel, settings.gain_dn, frames
        fitted = METHODS[method](work, shade, start, found, variance, (contrast, rho), settings)
    fitted[fit.SIGMA] *= np.sqrt(1 + SECOND_ORDER * contrast**2)
    return _profile(fitted, start, double, work.shape[1], axis, settings, least)


class _Noise:
    """Variance of a pixel without its photons, DN², and (constant, per DN) what the dark frame adds to it."""

    def __init__(self, pixel: float, settings: StripeSettings, with_dark: bool) -> None:
        self.pixel = pixel
        frames = settings.dark_frames
        self.of_dark = (pixel / frames, settings.gain_dn * (1 + 1 / frames)) if with_dark else (0.0, 0.0)


def extract_all(
    images: Iterable[Image],
    dark: NDArray[np.floating] | NDArray[np.uint8] | None = None,
    axis: Axis = "rows",
    settings: StripeSettings | None = None,
    threads: int = 2,
) -> Iterator[StripeProfile]:
    """The profiles of a stream of images, in its order, with `threads` cores: a picture each, no more ahead than that.

    Raises what `extract` raises, at the picture that it is about.
    """
    with ThreadPoolExecutor(threads, "stripe") as pool:
        waiting: deque[Future[StripeProfile]] = deque()
        for image in images:
            waiting.append(pool.submit(extract, image, dark, axis, settings))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


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


def _profile(
    fitted: Array,
    start: Array,
    double: NDArray[np.bool_],
    length: int,
    axis: Axis,
    settings: StripeSettings,
    least: float,
) -> StripeProfile:
    """The fitted lines that are believable stripes, with their standard deviations."""
    centre, width, fisher = fitted[fit.FIT_CENTRE], fitted[fit.WIDTH], fitted[fit.FISHER]
    low, high = settings.width_range_px
    with np.errstate(invalid="ignore"):
        keep = (width > low) & (width < high) & (fitted[fit.AMPLITUDE] > 0.5 * least)
        keep &= (centre > 1.5 * width) & (centre < length - 1 - 1.5 * width)
        keep &= np.abs(centre - start[:, 0, find.CENTRE]) < np.maximum(3.0, 2 * width)
        keep &= fisher < np.maximum(1.0, 0.5 * width)
        pixels = 8 * width + 2
        allowed = 1 + MISFIT_SIGMAS * np.sqrt(2 / pixels)
        sigma = fitted[fit.SIGMA] * np.sqrt(np.maximum(1.0, fitted[fit.CHI2] / allowed))
    nothing = ~keep
    for column in (centre, sigma, fitted[fit.AMPLITUDE], width):
        column[nothing] = np.nan
    return StripeProfile(
        axis=axis,
        centres=centre,
        sigma=sigma,
        amplitude=fitted[fit.AMPLITUDE],
        width=width,
        saturated=keep & (start[:, 0, find.CORE] > 0),
        double=keep & double,
    )
