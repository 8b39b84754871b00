"""The paper's equations (1) to (6), as printed and as corrected: code that says literally what each of them says.

Lengths in m, angles in rad, symbols as in the paper. `light_plane.closed_form` is the corrected (1) that the product
keeps; it is used here, everything else is only for the comparison in `equation_table`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def eq1_printed(x: Array, y: Array, baseline: float, focal: float, theta: float) -> Array:
    """Points (n, 3): (x, y, z) = l (x', y', f) / (f tanθ − x')."""
    d = focal * np.tan(theta) - x
    return np.column_stack([baseline * x / d, baseline * y / d, baseline * focal / d])


def eq2_printed(points: Array, travel: Array) -> Array:
    """Points (n, 3) with v t added to x; y and z "remain unchanged"."""
    return points + np.column_stack([travel, np.zeros((len(travel), 2))])


def eq2_corrected(points: Array, reading: Array, direction: Array) -> Array:
    """Points (n, 3) with the rail's reading times its calibrated direction (3,), which carries its scale."""
    return np.asarray(points + reading[:, None] * direction, dtype=np.float64)


def eq3_residual(
    height: ArrayLike, image: ArrayLike, theta_1: float, theta_2: float, distance: float, principal: float, alpha: float
) -> Array:
    """Left minus right side of (3) in m², as printed: zero where it holds."""
    s = np.asarray(height) / np.cos(theta_1)
    flat = np.asarray(image) * np.cos(alpha)
    both = theta_1 + theta_2
    return np.asarray(s * np.sin(both) * (principal - flat) - (distance - s * np.cos(both)) * flat, dtype=np.float64)


def eq3_solved(image: Array, theta_1: float, theta_2: float, distance: float, principal: float, alpha: float) -> Array:
    """The height (n,) at which (3) holds, from two evaluations: it is linear in X."""
    nothing = eq3_residual(np.zeros(len(image)), image, theta_1, theta_2, distance, principal, alpha)
    metre = eq3_residual(np.ones(len(image)), image, theta_1, theta_2, distance, principal, alpha)
    return np.asarray(-nothing / (metre - nothing), dtype=np.float64)


def eq4_printed(image: Array, theta_1: float, theta_2: float, distance: float, principal: float, alpha: float) -> Array:
    """X (n,) = x' L1 cosθ1 cosα / [(f − x' cosα) sin(θ1+θ2) + x' cos(θ1+θ2) cosα]."""
    flat, both = image * np.cos(alpha), theta_1 + theta_2
    below = (principal - flat) * np.sin(both) + flat * np.cos(both)
    return np.asarray(flat * distance * np.cos(theta_1) / below, dtype=np.float64)


def eq4_corrected(
    image: Array, theta_1: float, theta_2: float, distance: float, principal: float, tilt: float
) -> Array:
    """X (n,) with the axial term L2 + x' sinβ, β the detector's tilt (docs/explanation/theory.md, section 13)."""
    flat, both = image * np.cos(tilt), theta_1 + theta_2
    below = (principal + image * np.sin(tilt)) * np.sin(both) + flat * np.cos(both)
    return np.asarray(flat * distance * np.cos(theta_1) / below, dtype=np.float64)


def eq5_printed(
    x: Array, y: Array, baseline: float, focal: float, theta: float, delta_1: float, delta_2: float
) -> Array:
    """Errors (n, 3) as printed. In dy, x and y stand without a prime: they are the point's, and the stray δ is 1."""
    peak = focal / np.tan(theta)
    square = (peak - x) ** 2
    point_x, point_y = baseline * x / (peak - x), baseline * y / (peak - x)
    dy = (baseline * peak * delta_2 - baseline * point_x * delta_2 + baseline * point_y * delta_1) / square
    return np.column_stack([baseline * peak * delta_1 / square, dy, baseline * focal * delta_1 / square])


def eq5_corrected(
    x: Array, y: Array, baseline: float, focal: float, theta: float, delta_1: float, delta_2: float
) -> Array:
    """Errors (n, 3) with dy = (l f cotθ δ2 − l x' δ2 + l y' δ1)/D²."""
    peak = focal / np.tan(theta)
    square = (peak - x) ** 2
    dy = (baseline * peak * delta_2 - baseline * x * delta_2 + baseline * y * delta_1) / square
    return np.column_stack([baseline * peak * delta_1 / square, dy, baseline * focal * delta_1 / square])


def eq6(baseline: float, theta: float) -> float:
    """Where the light plane meets the optical axis: Z = l tanθ, printed and right."""
    return baseline * float(np.tan(theta))


def scheimpflug(theta_1: float, theta_2: float, distance: float, principal: float) -> float:
    """The detector's tilt in rad that keeps the whole beam in focus: tanβ = L2 / (L1 tan(θ1+θ2))."""
    return float(np.arctan2(principal, distance * np.tan(theta_1 + theta_2)))
