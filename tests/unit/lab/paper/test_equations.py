"""The paper's equations (3), (4), (5) and the tilt in focus, as docs/explanation/theory.md, section 13, corrects them.

Lengths in m, angles in rad, symbols as there. The truth is traced: rays met with planes.
"""

from __future__ import annotations

import numpy as np
import pytest

THETA_1, THETA_2, L1, FOCAL = 0.35, 0.44, 0.15, 8e-3
BOTH, L2 = THETA_1 + THETA_2, FOCAL * L1 / (L1 - FOCAL)
HEIGHTS = np.linspace(-0.009, 0.009, 7)


def image_of(height: float, tilt: float) -> float:
    """x' of a spot at `height` over the reference plane, which beam and optical axis cross at θ1 and θ2."""
    spot = height * np.array([-np.tan(THETA_1), 1.0])
    axis, across = np.array([np.sin(THETA_2), np.cos(THETA_2)]), np.array([np.cos(THETA_2), -np.sin(THETA_2)])
    lens, along = L1 * axis, np.cos(tilt) * across + np.sin(tilt) * axis
    # spot + t (lens − spot) = (L1 + L2) axis + x' along
    return float(np.linalg.solve(np.column_stack([lens - spot, -along]), (L1 + L2) * axis - spot)[1])


@pytest.mark.parametrize("tilt_deg", [-45.0, -30.0, 0.0, 45.0])
def test_the_height_of_an_oblique_beam_needs_the_sine_of_the_tilt(tilt_deg: float) -> None:
    """The printed (4) has −x' cos β in its place, so it holds for β = −45° alone."""
    tilt = np.radians(tilt_deg)
    image = np.array([image_of(height, tilt) for height in HEIGHTS])
    flat = image * np.cos(tilt)

    def height(axial: np.ndarray) -> np.ndarray:
        return L1 * np.cos(THETA_1) * flat / ((L2 + axial) * np.sin(BOTH) + flat * np.cos(BOTH))

    np.testing.assert_allclose(height(image * np.sin(tilt)), HEIGHTS, atol=1e-12)
    assert (np.abs(height(-flat) - HEIGHTS).max() < 1e-12) == (tilt_deg == -45.0)


def test_the_tilt_in_focus_images_the_whole_beam_sharply() -> None:
    tilt = np.arctan(L2 / (L1 * np.tan(BOTH)))
    for height in HEIGHTS:
        before = L1 - height / np.cos(THETA_1) * np.cos(BOTH)
        behind = L2 + image_of(height, tilt) * np.sin(tilt)
        assert 1 / before + 1 / behind == pytest.approx(1 / FOCAL, rel=1e-9)


def point_of(x: float, y: float, baseline: float, theta: float) -> np.ndarray:
    """Where the ray through x', y' meets the laser's fan, which stands at (−l, 0, 0) and holds the y axis."""
    ray, laser = np.array([x, y, FOCAL]), np.array([-baseline, 0.0, 0.0])
    middle, side = np.array([np.cos(theta), 0.0, np.sin(theta)]), np.array([0.0, 1.0, 0.0])
    # t ray = laser + a middle + b side
    return ray * np.linalg.solve(np.column_stack([ray, -middle, -side]), laser)[0]


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (-1e-3, 0.8e-3), (0.9e-3, 1e-3), (1e-3, -0.7e-3)])
def test_errors_of_a_point_are_the_derivatives_of_its_place(x: float, y: float) -> None:
    baseline, theta = 0.035, float(np.arctan(3.5))
    d1, d2 = 1e-8, -2e-8
    there, here = (point_of(x + s * d1 / 2, y + s * d2 / 2, baseline, theta) for s in (1, -1))
    peak = FOCAL / np.tan(theta)
    dy = baseline * (peak * d2 - x * d2 + y * d1)
    errors = np.array([baseline * peak * d1, dy, baseline * FOCAL * d1]) / (peak - x) ** 2
    np.testing.assert_allclose(errors, there - here, rtol=1e-6)
