"""The paper's equations (1) to (6), as printed and as corrected, beside ray-traced truth.

Lengths in m, angles in rad, symbols as in the paper. `light_plane.closed_form` is the corrected (1) that the product
keeps; it is used here, everything else is only for the comparison. The truth is traced: rays met
with planes by solving for their crossing, with nothing of the estimators' camera or light plane.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cell.measure.geometry.light_plane import closed_form
from lab.paper.design import HALF_SENSOR, STAND_OFF, TAN_THETA

Array = NDArray[np.float64]
BASELINE, FOCAL, THETA = 0.035, 8e-3, float(np.arctan(TAN_THETA))
GRID = 41
TRAVEL = 0.1
"""Rail travel over which (2) is tried, m."""
RAIL_TURN = 0.007
"""Angle between the rail and the camera's x axis, rad, one standard deviation of the simulated cell."""
RAIL_SCALE = 1.0015
DELTA_1, DELTA_2 = 0.48e-6, 0.48e-6
THETA_1, THETA_2, L1 = float(np.radians(20.0)), float(np.radians(25.0)), 0.150
L2 = FOCAL * L1 / (L1 - FOCAL)
HEIGHTS = (-0.010, 0.010)
"""Heights over which (3) and (4) are tried, m."""
EXACT_TILT = float(np.radians(-45.0))


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


def light_point(x: ArrayLike, y: ArrayLike, baseline: float, focal: float, theta: float) -> Array:
    """Points (n, 3) in m where the rays through sensor points x', y' (n,) in m meet the laser's fan.

    Camera at the origin looking along +z, upright image. The laser stands at (−baseline, 0, 0); its fan is spanned by
    the ray at the angle θ to the baseline and by the y axis. Each crossing solves t·ray = laser + a·middle + b·side.
    """
    xs, ys = np.atleast_1d(np.asarray(x, dtype=np.float64)), np.atleast_1d(np.asarray(y, dtype=np.float64))
    laser = np.array([-baseline, 0.0, 0.0])
    middle = np.array([np.cos(theta), 0.0, np.sin(theta)])
    side = np.array([0.0, 1.0, 0.0])
    rays = np.column_stack([xs, ys, np.full(len(xs), focal)])
    systems = np.stack([rays, np.tile(-middle, (len(xs), 1)), np.tile(-side, (len(xs), 1))], axis=2)
    shares = np.linalg.solve(systems, np.tile(laser, (len(xs), 1))[:, :, None])[:, 0]
    return np.asarray(rays * shares, dtype=np.float64)


def oblique_image(
    height: ArrayLike, theta_1: float, theta_2: float, distance: float, principal: float, tilt: float
) -> Array:
    """Image coordinate x' (n,) in m of a spot at `height` (n,) m above the reference plane, beam and camera oblique.

    Beam and optical axis cross on the reference plane, at θ1 and θ2 on either side of its normal. The lens stands
    `distance` m from the crossing (the paper's L1), the detector's middle `principal` m behind it (L2), turned by
    `tilt` from the perpendicular of the axis, so that its side for higher spots is farther from the lens for tilt > 0.
    """
    h = np.atleast_1d(np.asarray(height, dtype=np.float64))
    beam = np.array([-np.sin(theta_1), np.cos(theta_1)])
    axis = np.array([np.sin(theta_2), np.cos(theta_2)])
    across = np.array([axis[1], -axis[0]])
    lens = distance * axis
    middle = lens + principal * axis
    along = np.cos(tilt) * across + np.sin(tilt) * axis
    found = np.empty(len(h))
    for k, value in enumerate(h):
        spot = value / np.cos(theta_1) * beam
        # spot + t (lens − spot) = middle + x' along
        found[k] = np.linalg.solve(np.column_stack([lens - spot, -along]), middle - spot)[1]
    return found


def equation_table() -> dict[str, Any]:
    """The table as plain data: rows with equation, what was compared, largest deviation in mm of both forms."""
    return {
        "note": "largest deviation from ray-traced truth over the grid; traced without the product's own geometry; "
        "the paper's α is read as the tilt β of the detector",
        "assumed": {
            "baseline_mm": 1e3 * BASELINE,
            "focal_mm": 1e3 * FOCAL,
            "tan_theta": TAN_THETA,
            "half_sensor_mm": 1e3 * HALF_SENSOR,
            "grid": f"{GRID} × {GRID}",
            "rail_travel_mm": 1e3 * TRAVEL,
            "rail_turn_mrad": 1e3 * RAIL_TURN,
            "rail_scale": RAIL_SCALE,
            "stripe_error_um": 1e6 * DELTA_1,
            "theta_1_deg": float(np.degrees(THETA_1)),
            "theta_2_deg": float(np.degrees(THETA_2)),
            "L1_mm": 1e3 * L1,
            "L2_mm": 1e3 * L2,
            "heights_mm": [1e3 * h for h in HEIGHTS],
        },
        "rows": [*_triangulation(), *_oblique(), *_errors(), *_meeting_point()],
    }


def _sensor() -> tuple[Array, Array]:
    side = np.linspace(-HALF_SENSOR, HALF_SENSOR, GRID)
    x, y = np.meshgrid(side, side)
    return x.ravel(), y.ravel()


def _row(equation: str, compared: str, printed: float | None, corrected: float, verdict: str) -> dict[str, Any]:
    return {
        "equation": equation,
        "compared": compared,
        "printed_mm": None if printed is None else 1e3 * printed,
        "corrected_mm": 1e3 * corrected,
        "verdict": verdict,
    }


def _largest(found: Array, truth: Array) -> float:
    return float(np.linalg.norm(np.atleast_2d(found - truth), axis=-1).max())


def _triangulation() -> list[dict[str, Any]]:
    x, y = _sensor()
    truth = light_point(x, y, BASELINE, FOCAL, THETA)
    corrected = closed_form(x, y, BASELINE, FOCAL, THETA)
    printed = eq1_printed(x, y, BASELINE, FOCAL, THETA)
    # The rail's own direction, its turn shared between y and z, and its scale per metre of reading.
    way = np.array([1.0, RAIL_TURN / np.sqrt(2), -RAIL_TURN / np.sqrt(2)])
    direction = RAIL_SCALE * way / np.linalg.norm(way)
    reading = np.linspace(0.0, TRAVEL, len(x))
    moved = truth + reading[:, None] * direction
    return [
        _row("(1)", "point (x, y, z)", _largest(printed, truth), _largest(corrected, truth),
             "cot, not tan: θ is between baseline and light plane, as (5) and (6) use it"),
        _row("(2)", "point after the sweep, on (1) as printed", _largest(eq2_printed(printed, reading), moved),
             _largest(eq2_corrected(corrected, reading, direction), moved), "carries the fault of (1)"),
        _row("(2)", "the same on (1) as corrected", _largest(eq2_printed(corrected, reading), moved),
             _largest(eq2_corrected(corrected, reading, direction), moved),
             "right only along exactly x: the direction has to be calibrated"),
    ]  # fmt: skip


def _oblique() -> list[dict[str, Any]]:
    heights = np.linspace(*HEIGHTS, GRID)
    rows = []
    in_focus = scheimpflug(THETA_1, THETA_2, L1, L2)
    for name, tilt in (("in focus (Scheimpflug)", in_focus), ("upright", 0.0), ("the exception", EXACT_TILT)):
        image = oblique_image(heights, THETA_1, THETA_2, L1, L2, tilt)
        given = (THETA_1, THETA_2, L1, L2, tilt)
        right = _largest_height(eq4_corrected(image, *given), heights)
        compared = f"height X, detector {name}, β = {np.degrees(tilt):.2f}°"
        exact = "exact only for β = −45°"
        verdict = exact if tilt == EXACT_TILT else "the axial term needs the sine of the tilt, with its sign"
        printed = _largest_height(eq3_solved(image, *given), heights)
        rows.append(_row("(3)", compared + ", solved for X", printed, right, verdict))
        verdict = exact if tilt == EXACT_TILT else "follows exactly from (3), and shares its fault"
        rows.append(_row("(4)", compared, _largest_height(eq4_printed(image, *given), heights), right, verdict))
    return rows


def _largest_height(found: Array, truth: Array) -> float:
    return float(np.abs(found - truth).max())


def _errors() -> list[dict[str, Any]]:
    x, y = _sensor()
    given = (BASELINE, FOCAL, THETA)
    # Half a step to either side: what is left of the second order is far below the first.
    apart = light_point(x + DELTA_1 / 2, y + DELTA_2 / 2, *given) - light_point(
        x - DELTA_1 / 2, y - DELTA_2 / 2, *given
    )
    printed = eq5_printed(x, y, *given, DELTA_1, DELTA_2)
    corrected = eq5_corrected(x, y, *given, DELTA_1, DELTA_2)
    verdicts = ("right", "x and y have lost their primes and a δ strayed in", "right")
    return [
        _row("(5)", f"d{axis} for a stripe error of 0.48 µm, largest {1e3 * np.abs(apart[:, k]).max():.4f} mm",
             float(np.abs(printed[:, k] - apart[:, k]).max()), float(np.abs(corrected[:, k] - apart[:, k]).max()),
             verdicts[k])
        for k, axis in enumerate("xyz")
    ]  # fmt: skip


def _meeting_point() -> list[dict[str, Any]]:
    truth = float(light_point(0.0, 0.0, BASELINE, FOCAL, THETA)[0, 2])
    off = abs(eq6(BASELINE, THETA) - truth)
    return [
        _row("(6)", "Z where the light plane meets the optical axis", off, off, "right: 122.5 mm"),
        _row("(6)", "the 150 mm that the text gives for it", abs(STAND_OFF - truth), off,
             "150 mm is the stand-off, imaged at x' = 0.419 mm"),
    ]  # fmt: skip
