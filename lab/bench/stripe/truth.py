"""Pictures of a stripe with known centres, and the Cramér–Rao bound of their noise: nothing here is the estimator's.

A Gaussian integrated over pixels, on a gradient; Poisson electrons, Gaussian read noise, 8 bits; speckle as the
intensity of a smoothed complex Gaussian field. docs/explanation/theory.md, section 5: 40 electrons per DN, read noise
0.4 DN.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import erf

Array = NDArray[np.float64]

ELECTRONS_PER_DN = 40.0
READ_NOISE_DN = 0.4
FIELD_SMOOTHING = 0.8
"""Standard deviation in px of what smooths the speckle's field; intensities then correlate as exp(−r²/2s²)."""


@dataclass(frozen=True)
class Cell:
    """One condition: stripe width σ in px, peak in DN, speckle contrast, ambient light in DN and its slope in DN/px."""

    width: float
    peak: float
    contrast: float = 0.0
    ambient: float = 8.0
    slope: float = 0.02


def draw(cell: Cell, shape: tuple[int, int], seed: int) -> tuple[NDArray[np.uint8], Array]:
    """A picture (h, w) and the true centre (h,) of each row: a gentle curve that meets all sub-pixel places."""
    rng = np.random.default_rng(seed)
    height, width = shape
    row = np.arange(height)
    centres = (0.5 + 0.05 * np.sin(row / 150 + seed)) * width + 0.0317 * row + rng.uniform(-1, 1)
    half = int(np.ceil(6 * cell.width)) + 2
    first = np.floor(centres).astype(int) - half
    column = first[:, None] + np.arange(2 * half + 1)
    stripe = cell.peak * _integrated(column, centres[:, None], cell.width)
    if cell.contrast:
        parts = [gaussian_filter(rng.normal(size=shape), FIELD_SMOOTHING) for _ in range(2)]
        intensity = parts[0] ** 2 + parts[1] ** 2
        intensity = (intensity / intensity.mean())[row[:, None], column]
        stripe = stripe * np.maximum(1 + cell.contrast * (intensity - 1), 0)
    light = np.broadcast_to(cell.ambient + cell.slope * np.arange(width), shape).copy()
    light[row[:, None], column] += stripe
    signal = rng.poisson(light * ELECTRONS_PER_DN) / ELECTRONS_PER_DN + rng.normal(0, READ_NOISE_DN, shape)
    return np.clip(np.round(signal), 0, 255).astype(np.uint8), centres


def bound(cell: Cell, shape: tuple[int, int]) -> float:
    """Least standard deviation in px of an unbiased centre in one row, averaged over the place within a pixel.

    From the Fisher information of all the row's pixels with centre, height, width and a linear background unknown; the
    noise is photons, read noise, rounding (1/12 DN²) and the speckle with its correlation along the row.
    """
    half = 60
    variances = []
    for phase in np.linspace(-0.5, 0.5, 4, endpoint=False):
        x = np.arange(-half, half + 1.0)
        step = 1e-4
        stripe = cell.peak * _integrated(x, phase, cell.width)
        by_centre = (_integrated(x, phase + step, cell.width) - _integrated(x, phase - step, cell.width)) / (2 * step)
        by_width = (_integrated(x, phase, cell.width + step) - _integrated(x, phase, cell.width - step)) / (2 * step)
        jacobian = np.stack([cell.peak * by_centre, stripe, cell.peak * by_width, np.ones_like(x), x / half], axis=1)
        light = stripe + cell.ambient + cell.slope * (x + 0.5 * shape[1])
        covariance = np.diag(light / ELECTRONS_PER_DN + READ_NOISE_DN**2 + 1 / 12)
        if cell.contrast:
            rho = np.exp(-((x[:, None] - x) ** 2) / (2 * FIELD_SMOOTHING**2))
            covariance = covariance + cell.contrast**2 * stripe[:, None] * rho * stripe
        information = jacobian.T @ np.linalg.solve(covariance, jacobian)
        variances.append(np.linalg.inv(information)[0, 0])
    return float(np.sqrt(np.mean(variances)))


def _integrated(x: Array | NDArray[np.intp], centre: Array | float, width: float) -> Array:
    """A Gaussian of height 1, averaged over the pixel at x."""
    scale = 1 / (np.sqrt(2) * width)
    area = erf((x + 0.5 - centre) * scale) - erf((x - 0.5 - centre) * scale)
    return np.asarray(width * np.sqrt(np.pi / 2) * area, dtype=np.float64)
