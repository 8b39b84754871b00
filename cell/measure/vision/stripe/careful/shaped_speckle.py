"""How strong the speckle is in lines that were fitted with a profile of any shape.

As `speckle.py` does for a Gaussian: what the fit leaves of speckle is computed, not guessed, for it swallows most of
what is coarse. The texture of a surface that the laser lights shows in the same way and counts as speckle.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.careful.shape import Shape
from cell.measure.vision.stripe.careful.shaped_fit import Fitted, Noise
from cell.measure.vision.stripe.careful.speckle import ASSUMED_GRAIN

Array = NDArray[np.float64]

ALIKE = 0.35
"""Lines whose amplitude differs from the typical one by no more than this share are compared with it."""
LEAST_LINES, KEPT = 12, 0.95
SIGNIFICANT = 3.0
SCALE_PRIOR = 0.15
PHASES = (-0.375, -0.125, 0.125, 0.375)


def speckled(fitted: Fitted, clear: NDArray[np.bool_], noise: Noise, shape: Shape) -> Noise:
    """The noise with the contrast that the residuals of the `clear` lines (m,) show under the stripe, at most 1."""
    if not clear.any():
        return noise
    typical = float(np.median(fitted.amplitude[clear]))
    whole = np.isfinite(fitted.variance).mean(axis=1) > 0.9
    alike = clear & whole & (np.abs(fitted.amplitude - typical) < ALIKE * typical)
    if alike.sum() < LEAST_LINES:
        return replace(noise, contrast=0.0)
    usable = np.isfinite(fitted.variance[alike])
    height = fitted.amplitude[alike, None]
    profile = np.where(usable, fitted.stripe[alike] / height, 0.0)
    power = np.sum(profile**2 * (np.where(usable, fitted.residual[alike], 0.0) / height) ** 2, axis=1)
    power = power[power <= np.quantile(power, KEPT)]
    level = float(np.median(fitted.level[alike]))
    photons, speckle = _left(shape, typical, level, noise)
    excess = float(power.mean()) - photons * KEPT
    if excess < SIGNIFICANT * float(power.std()) / np.sqrt(len(power)):
        return replace(noise, contrast=0.0)
    return replace(noise, contrast=float(np.sqrt(min(excess / speckle, 1.0))))


def _left(shape: Shape, amplitude: float, level: float, noise: Noise) -> tuple[float, float]:
    """What the fit leaves of the noise without speckle and of speckle of contrast 1, as `speckled` sums it."""
    half = int(np.ceil(shape.reach)) + 1
    photons, speckle = 0.0, 0.0
    for phase in PHASES:
        x: Array = np.arange(-half, half + 1.0) - np.float64(phase)
        profile, slope = shape.at(x)
        variance = noise.floor + noise.gain * np.maximum(amplitude * profile + level, 0.0)
        weight = 1 / (variance + (noise.contrast * amplitude * profile) ** 2)
        jacobian = np.stack(
            [amplitude * slope, profile, amplitude * slope * x, np.ones_like(x), x / half], axis=1
        )  # fmt: skip
        normal = jacobian.T @ (weight[:, None] * jacobian)
        normal[2, 2] += SCALE_PRIOR**-2
        kept = np.eye(len(x)) - jacobian @ np.linalg.solve(normal, (weight[:, None] * jacobian).T)
        rows = kept * profile[:, None] / amplitude
        photons += float(np.sum(rows**2 * variance)) / len(PHASES)
        pulled = rows * (amplitude * profile)
        grain = np.exp(-((x[:, None] - x) ** 2) / (4 * ASSUMED_GRAIN**2))
        speckle += float(np.sum((pulled @ grain) * pulled)) / len(PHASES)
    return photons, speckle
