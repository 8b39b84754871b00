"""What the extraction of a stripe may assume, and what it gives: centres with a standard deviation each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.careful.speckle import Speckle
from cell.measure.vision.stripe.marks import Mark as Mark
from cell.measure.vision.stripe.marks import marks_of

if TYPE_CHECKING:
    from cell.measure.vision.stripe.careful.careful import Learned

Array = NDArray[np.float64]
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
    variance of a pixel in DN², without photons and whole (`stripe_noise.pixel_noise`). `rival` (n,) is the height of
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
