"""How strong and how coarse the laser's speckle is, measured in the picture itself.

Residuals of fitted lines are compared with what the fit leaves of photon noise and of speckle of contrast 1, grain by
grain: the fit swallows much of a coarse speckle, and that share is computed, not guessed. Without speckle in the
weights and correlation in the deviation, a stated σ is 1.4 to 2.2 times too small (theory sheet, part 3).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.vision.compiled import compiled
from cell.vision.stripe_fit import AMPLITUDE, FIT_CENTRE, LEVEL, SLOPE, WIDTH, WIDTH_PRIOR

# Correlation of two pixels at distance r is exp(−r²/4 grain²); a lens at f/4 to f/8 with pixels of 5 µm gives .3 to 1.
GRAINS = np.array([0.3, 0.45, 0.6, 0.75, 0.9, 1.1, 1.3])
CORE = 2.0
"""Residuals within this many stripe widths of the centre count: farther out there is no speckle to see."""
LEAST_LINES = 12
# Under a narrow stripe few residuals are left, and a finer grain cannot be told from a weaker speckle.
NARROW, NARROW_GRAIN = 1.8, 0.75
# Speckle below this share of the photon noise's variance at the peak, or not above its own uncertainty, is none.
NEGLIGIBLE, SIGNIFICANT = 0.05, 3.0


@compiled
def residual_moments(
    image: Any, dark: Any, with_dark: bool, which: Any, fitted: Any, noise2: float, gain: float, contrast2: float
) -> Any:
    """Sums (lines, 3) of e_i e_i, e_i e_{i+1}, e_i e_{i+2} over the core of each line, e the whitened residual.

    NaN where the core leaves the picture. `fitted` is from `fit_lines`, made with the same noise.
    """
    n = image.shape[1]
    out = np.full((len(which), 3), np.nan)
    for k in range(len(which)):
        r = which[k]
        centre, width, amplitude = fitted[FIT_CENTRE, r], fitted[WIDTH, r], fitted[AMPLITUDE, r]
        if not (centre > CORE * width + 1.0 and centre < n - 2.0 - CORE * width):
            continue
        origin = np.floor(centre + 0.5)
        one, two, sums0, sums1, sums2 = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(int(np.ceil(centre - CORE * width)), int(np.floor(centre + CORE * width)) + 1):
            stripe = amplitude * np.exp(-0.5 * ((i - centre) / width) ** 2)
            shade = float(dark[r, i]) if with_dark else 0.0
            mean = stripe + fitted[LEVEL, r] + fitted[SLOPE, r] * (i - origin)
            variance = noise2 + gain * max(mean + shade, 0.0) + contrast2 * stripe * stripe
            error = (image[r, i] - shade - mean) / np.sqrt(variance)
            sums0 += error * error
            sums1 += error * one
            sums2 += error * two
            one, two = error, one
        out[k, 0], out[k, 1], out[k, 2] = sums0, sums1, sums2
    return out


@lru_cache(maxsize=256)
def expected_moments(
    width: float, amplitude: float, level: float, noise2: float, gain: float, contrast2: float
) -> NDArray[np.float64]:
    """What `residual_moments` gives on average, (1 + grains, 3): of photon noise, then of speckle of contrast 1."""
    half = int(4.0 * width + 3.0)
    out = np.zeros((1 + len(GRAINS), 3))
    # Of a narrow stripe it matters how many pixels the core holds.
    phases = 5 if width < 2.0 else 2
    for phase in range(phases):
        x = np.arange(-half, half + 1) - phase / phases
        z = x / width
        stripe = amplitude * np.exp(-0.5 * z * z)
        photon = noise2 + gain * (stripe + max(level, 0.0))
        root = 1.0 / np.sqrt(photon + contrast2 * stripe * stripe)
        basis = (stripe * z / width, stripe / amplitude, stripe * z * z, np.ones_like(x), x / 8.0)
        jacobian = root[:, None] * np.stack(basis, axis=1)
        normal = jacobian.T @ jacobian
        normal[2, 2] += WIDTH_PRIOR**-2
        left = np.eye(len(x)) - jacobian @ np.linalg.solve(normal, jacobian.T)
        rows = left[np.abs(z) <= CORE] * root
        pulled = rows * stripe
        distance2 = (x[:, None] - x) ** 2
        covariances = [(rows * photon) @ rows.T]
        covariances += [pulled @ np.exp(-distance2 / (4 * grain**2)) @ pulled.T for grain in GRAINS]
        out += np.array([[np.trace(c, offset=lag) for lag in range(3)] for c in covariances]) / phases
    return out


def _rounded(value: float, step: float) -> float:
    """To a geometric grid, so that a stream of like pictures asks for the same moments."""
    return float(np.exp(step * np.round(np.log(max(value, 0.1)) / step)))


def measure_speckle(
    image: Any,
    dark: Any,
    with_dark: bool,
    which: Any,
    fitted: Any,
    noise2: float,
    gain: float,
    contrast: float,
) -> tuple[float, float] | None:
    """Contrast and grain (px) of the speckle in the lines `which`, fitted with `contrast`; None when they are too few.

    Anything else that the model does not explain, such as the texture of the surface, counts as speckle.
    """
    moments = residual_moments(image, dark, with_dark, which, fitted, noise2, gain, contrast**2)
    # A line with an edge of the scene or a second stripe in it says nothing on speckle.
    with np.errstate(invalid="ignore"):
        kept = moments[:, 0] < 8 * max(float(np.nanmedian(moments[:, 0])), 0.1) if len(which) else np.zeros(0, bool)
    if np.count_nonzero(kept) < LEAST_LINES:
        return None
    lines = which[kept]
    seen = moments[kept].mean(axis=0)
    middle = np.median(fitted[:, lines], axis=1)
    width, amplitude, level = float(middle[WIDTH]), float(middle[AMPLITUDE]), float(middle[LEVEL])
    if with_dark:
        level += float(np.median(dark[lines]))
    typical = _rounded(width, 0.03), _rounded(amplitude, 0.04), _rounded(level, 0.1), _rounded(noise2, 0.1)
    expected = expected_moments(*typical, gain, contrast**2)
    excess = seen - expected[0]
    peak_noise = noise2 + gain * (amplitude + max(level, 0.0))
    ratios = (expected[1:, 1] + expected[1:, 2]) / expected[1:, 0]
    ratio = (excess[1] + excess[2]) / max(excess[0], 1e-9)
    order = np.argsort(ratios)
    grain = float(np.interp(ratio, ratios[order], GRAINS[order]))
    if width < NARROW:
        grain = max(grain, NARROW_GRAIN)
    per_contrast = float(np.interp(grain, GRAINS, expected[1:, 0]))
    contrast2 = float(excess[0]) / per_contrast
    doubt = SIGNIFICANT * float(moments[kept, 0].std()) / np.sqrt(len(lines))
    if contrast2 * amplitude**2 < NEGLIGIBLE * peak_noise or excess[0] < doubt:
        return 0.0, grain
    # Developed speckle has contrast 1; more is a misfit.
    return float(np.sqrt(min(contrast2, 1.0))), grain


def correlation(grain: float) -> Any:
    """Correlations (m,) of speckle at lags 1 … m px, as far as they matter."""
    rho = np.exp(-(np.arange(1, 7) ** 2) / (4 * grain**2))
    return rho[rho > 0.01].astype(np.float32)
