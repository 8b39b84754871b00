"""Sub-pixel centres of the laser stripe, one per image row (or column), with an honest standard deviation each.

Largest value, box-sum centre within ±12 px, then weighted maximum likelihood with saturated pixels masked and speckle
in the weights (theory sheet, part 3). What a centre means in space is the business of the geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cell.vision import stripe_kernel as kernel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Correlated speckle makes the predicted σ 1.4 to 2.2 times too small (theory sheet, part 3).
SPECKLE_INFLATION = 1.6
# Peaks per row that compete for being the stripe.
CANDIDATES = 2


@dataclass(frozen=True)
class StripeSettings:
    """What the extraction may assume about camera and stripe; DN are the image's grey values."""

    least_peak_dn: float = 8.0
    read_noise_dn: float = 0.5
    gain_dn: float = 1 / 40  # variance per DN of signal: 1/(electrons per DN)
    speckle_contrast: float = 0.15
    saturation_dn: int = 255
    width_range_px: tuple[float, float] = (0.45, 9.0)
    steps: int = 6


@dataclass(frozen=True)
class StripeProfile:
    """One stripe: arrays of length n, one entry per image row (axis "rows") or column; NaN where there is no stripe.

    `centres` and `sigma` (one standard deviation of the centre) in px, `amplitude` in DN (of the fitted peak, above the
    sensor's range in `saturated` rows), `width` the stripe's σ in px. `double` marks rows with a second
    peak of comparable energy; the stronger one was taken.
    """

    axis: Literal["rows", "columns"]
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
    axis: Literal["rows", "columns"] = "rows",
    settings: StripeSettings | None = None,
) -> StripeProfile:
    """Stripe centres of an 8-bit image (h, w), one per row (or per column with axis "columns").

    `dark` (h, w) is a frame of the same view without the laser and is subtracted. Raises ValueError for an image of
    another type or a dark frame of another size.
    """
    settings = settings or StripeSettings()
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"the stripe needs a grey 8-bit image, not {image.dtype} of shape {image.shape}")
    if dark is not None and dark.shape != image.shape:
        raise ValueError(f"the dark frame is {dark.shape}, the image {image.shape}: take both with the same camera")
    if min(image.shape) < 32:
        raise ValueError(f"the image is {image.shape[1]}×{image.shape[0]} px; at least 32×32 are needed")
    work = np.ascontiguousarray(image if axis == "rows" else image.T)
    background = np.empty((0, 0), np.float32)
    if dark is not None:
        background = np.ascontiguousarray(dark if axis == "rows" else dark.T, dtype=np.float32)
    noise = max(settings.read_noise_dn, _noise(work))
    start = _starts(work, background, max(settings.least_peak_dn, 5 * noise), settings.saturation_dn)
    fitted = np.empty((work.shape[0], kernel.COLUMNS))
    kernel.fit_rows(
        work,
        background,
        start,
        _smooth_widths(start[:, 1], start[:, 4] > 0, settings.width_range_px),
        settings.saturation_dn,
        noise,
        settings.gain_dn,
        settings.speckle_contrast,
        settings.steps,
        fitted,
    )
    return _profile(fitted, start, work.shape[1], axis, settings)


def _starts(image: Image, dark: NDArray[np.float32], least_peak: float, saturation: int) -> Array:
    """Start values (h, START_COLUMNS) of each row, from its three largest peaks."""
    erasable = image.copy()
    if dark.size:
        lit = np.clip(image - np.round(dark), 0, 255).astype(np.uint8)
        erasable = np.where(image >= saturation, image, lit)
    start = np.zeros((len(image), kernel.START_COLUMNS))
    for _ in range(CANDIDATES):
        kernel.find_rows(erasable, erasable.argmax(axis=1), saturation, least_peak, start)
    return start


def _profile(
    fitted: Array, start: Array, columns: int, axis: Literal["rows", "columns"], settings: StripeSettings
) -> StripeProfile:
    """The fitted rows that are believable stripes, with their standard deviations."""
    centre, width = fitted[:, kernel.CENTRE], fitted[:, kernel.WIDTH]
    low, high = settings.width_range_px
    with np.errstate(invalid="ignore"):
        keep = (width > low) & (width < high) & (fitted[:, kernel.AMPLITUDE] > 0.5 * settings.least_peak_dn)
        keep &= (centre > 1.5 * width) & (centre < columns - 1 - 1.5 * width)
        keep &= np.abs(centre - start[:, 0]) < np.maximum(3.0, 2 * width)
        keep &= fitted[:, kernel.SIGMA] < np.maximum(1.0, 0.5 * width)
        inflation = np.sqrt(np.clip(fitted[:, kernel.CHI2], 1.0, None))
    if settings.speckle_contrast > 0:
        inflation = inflation * SPECKLE_INFLATION

    def column(index: int) -> Array:
        return np.where(keep, fitted[:, index], np.nan)

    return StripeProfile(
        axis=axis,
        centres=column(kernel.CENTRE),
        sigma=column(kernel.SIGMA) * inflation,
        amplitude=column(kernel.AMPLITUDE),
        width=column(kernel.WIDTH),
        saturated=keep & (fitted[:, kernel.SATURATED] > 0),
        double=keep & (fitted[:, kernel.DOUBLE] > 0),
    )


def _noise(image: Image) -> float:
    """Noise of one pixel in DN, from the differences of neighbours in some rows; structure is trimmed away."""
    sample = image[:: max(1, len(image) // 5)].astype(np.int16)
    steps = np.abs(np.diff(sample, axis=1)).ravel()
    kept = steps[steps <= 4 * (np.median(steps) + 1)]
    return float(np.sqrt(np.mean(kept.astype(np.float64) ** 2) / 2))


def _smooth_widths(widths: Array, found: NDArray[np.bool_], allowed: tuple[float, float]) -> Array:
    """Running mean over 15 rows of the start widths (n,), which are counts of pixels and coarse one by one."""
    if not found.any():
        return np.ones(len(widths))
    clipped = np.where(found, np.clip(widths, *allowed), 0.0)
    box = np.ones(15)
    count = np.convolve(found.astype(np.float64), box, "same")
    total = np.convolve(clipped, box, "same")
    smooth = np.divide(total, count, out=np.full(len(widths), float(np.mean(clipped[found]))), where=count > 0)
    return np.asarray(np.clip(smooth, *allowed), dtype=np.float64)
