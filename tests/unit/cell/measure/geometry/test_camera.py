"""Promises of `cell.measure.geometry.camera`."""

import cv2
import numpy as np
import pytest

from cell.measure.geometry.camera import CameraModel


@pytest.mark.parametrize("lens", [(-0.4, 0, 0, 0, 0), (-0.45, 0.25, 1e-3, -1e-3, -0.08), (0.3, -0.5, 0, 0, 0)])
def test_a_pixel_beyond_the_fold_of_a_lens_has_no_ray_and_all_within_it_have(lens):
    """Where the slope of the distorted radius becomes 0 the picture ends; farther out the formula comes back in."""
    camera = CameraModel(1280, 1024, 400.0, 400.0, 640.0, 512.0, lens)
    radius = np.linspace(0.0, 3.0, 300_001)
    seen = radius + sum(k * radius**power for k, power in zip((lens[0], lens[1], lens[4]), (3, 5, 7), strict=True))
    fold = int(np.argmax(np.diff(seen) <= 0))
    around = np.linspace(0, 2 * np.pi, 40)[:, None, None]
    circles = np.concatenate([np.cos(around), np.sin(around)], axis=1)
    inside = (circles * np.linspace(0, 0.97 * radius[fold], 30)).transpose(0, 2, 1).reshape(-1, 2)
    points = np.column_stack([inside, np.ones(len(inside))])
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(lens))[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.normalised(pixels), inside, atol=1e-9)
    outside = (circles * np.linspace(1.02, 3.0, 60) * seen[fold]).transpose(0, 2, 1).reshape(-1, 2)
    assert np.isnan(camera.normalised(camera.matrix[:2, 2] + 400.0 * outside)).all()
