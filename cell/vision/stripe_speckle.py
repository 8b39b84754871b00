"""How strong and how coarse the laser's speckle is, measured in the picture itself.

Residuals of fitted lines are compared with what the fit leaves of photon noise and of speckle of contrast 1, for its
grain: the fit swallows much of a coarse speckle, and that share is computed, not guessed. The grain is seen across the
lines, where nothing is swallowed: round grains correlate a line with the next as they correlate a pixel with the next.
Without speckle in the weights and correlation in the deviation, a stated σ is 1.4 to 2.2 times too small (theory sheet,
part 3).
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
PHASES = 8
ASSUMED_GRAIN = 0.7
"""Grain in px where no speckle shows."""
# Speckle below this share of the photon noise's variance at the peak, or not above its own uncertainty, is none.
NEGLIGIBLE, SIGNIFICANT = 0.05, 3.0


@compiled
def residual_moments(
    image: Any, dark: Any, with_dark: bool, which: Any, fitted: Any, noise2: float, gain: float, contrast2: float
) -> Any:
    """Sums (lines, 3) over the cores of the lines `which`: e e of the line; e e' with the next line's residuals e', and
    (e e + e' e') / 2, both over the columns that the two cores share. e are whitened residuals.

    NaN where a core leaves the picture. `fitted` is from `fit_lines`, made with the same noise, for these lines and the
    next ones.
    """
    n = image.shape[1]
    out = np.full((len(which), 3), np.nan)
    errors = np.zeros((2, n))
    for k in range(len(which)):
        low, high = np.zeros(2, np.int64), np.zeros(2, np.int64)
        for j in range(2):
            r = which[k] + j
            centre, width, amplitude = fitted[FIT_CENTRE, r], fitted[WIDTH, r], fitted[AMPLITUDE, r]
            if not (centre > CORE * width + 1.0 and centre < n - 2.0 - CORE * width):
                continue
            origin = np.floor(centre + 0.5)
            low[j], high[j] = int(np.ceil(centre - CORE * width)), int(np.floor(centre + CORE * width)) + 1
            for i in range(low[j], high[j]):
                stripe = amplitude * np.exp(-0.5 * ((i - centre) / width) ** 2)
                shade = float(dark[r, i]) if with_dark else 0.0
                mean = stripe + fitted[LEVEL, r] + fitted[SLOPE, r] * (i - origin)
                variance = noise2 + gain * max(mean + shade, 0.0) + contrast2 * stripe * stripe
                errors[j, i] = (image[r, i] - shade - mean) / np.sqrt(variance)
        if high[0] == 0 or high[1] == 0:
            continue
        own, cross, shared = 0.0, 0.0, 0.0
        for i in range(low[0], high[0]):
            own += errors[0, i] ** 2
        for i in range(max(low[0], low[1]), min(high[0], high[1])):
            cross += errors[0, i] * errors[1, i]
            shared += 0.5 * (errors[0, i] ** 2 + errors[1, i] ** 2)
        out[k, 0], out[k, 1], out[k, 2] = own, cross, shared
    return out


@lru_cache(maxsize=256)
def expected_energy(
    width: float, amplitude: float, level: float, noise2: float, gain: float, contrast2: float
) -> NDArray[np.float64]:
    """What e e of a line is on average, (1 + grains,): of photon noise, then of speckle of contrast 1 of each grain."""
    half = int(4.0 * width + 3.0)
    out = np.zeros(1 + len(GRAINS))
    # Much of what is left lies at the core's ends: how many pixels it holds depends on where in a pixel the centre is.
    for phase in (np.arange(PHASES) + 0.5) / PHASES:
        x = np.arange(-half, half + 1) - phase
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
        out += np.array([np.trace(c) for c in covariances]) / PHASES
    return out


def _rounded(value: float, step: float) -> float:
    """To a geometric grid, so that a stream of like pictures asks for the same energies."""
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
    """Contrast and grain (px) of the speckle in the lines `which`; None when they are too few.

    These and the lines after them are `fitted` with `contrast`. Anything else that the model does not explain, such as
    the texture of the surface, counts as speckle.
    """
    moments = residual_moments(image, dark, with_dark, which, fitted, noise2, gain, contrast**2)
    # A line with an edge of the scene or a second stripe in it says nothing on speckle.
    with np.errstate(invalid="ignore"):
        kept = moments[:, 0] < 8 * max(float(np.nanmedian(moments[:, 0])), 0.1) if len(which) else np.zeros(0, bool)
    if np.count_nonzero(kept) < LEAST_LINES:
        return None
    lines = which[kept]
    own, cross, shared = moments[kept].mean(axis=0)
    middle = np.median(fitted[:, lines], axis=1)
    width, amplitude, level = float(middle[WIDTH]), float(middle[AMPLITUDE]), float(middle[LEVEL])
    if with_dark:
        level += float(np.median(dark[lines]))
    typical = _rounded(width, 0.03), _rounded(amplitude, 0.04), _rounded(level, 0.1), _rounded(noise2, 0.1)
    expected = expected_energy(*typical, gain, contrast**2)
    excess = own - expected[0]
    doubt = SIGNIFICANT * float(moments[kept, 0].std()) / np.sqrt(len(lines))
    if excess < doubt:
        return 0.0, ASSUMED_GRAIN
    # Of what both lines' residuals hold in the columns that they share, the speckle has the share that it has in all.
    correlated = cross / max(shared * excess / own, 1e-9)
    grain = float(np.sqrt(-0.25 / np.log(np.clip(correlated, *np.exp(-0.25 / GRAINS[[0, -1]] ** 2)))))
    contrast2 = excess / float(np.interp(grain, GRAINS, expected[1:]))
    peak_noise = noise2 + gain * (amplitude + max(level, 0.0))
    if contrast2 * amplitude**2 < NEGLIGIBLE * peak_noise:
        return 0.0, grain
    # Developed speckle has contrast 1; more is a misfit.
    return float(np.sqrt(min(contrast2, 1.0))), grain


def correlation(grain: float) -> Any:
    """Correlations (m,) of speckle at lags 1 … m px, as far as they matter."""
    rho = np.exp(-(np.arange(1, 7) ** 2) / (4 * grain**2))
    return rho[rho > 0.01].astype(np.float32)
