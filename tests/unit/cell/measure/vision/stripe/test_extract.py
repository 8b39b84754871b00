"""Promises of the stripe extraction, on pictures drawn from a formula; how near to its bound: test_stripe_bound."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cell.measure.vision.stripe.extract import StripeSettings, extract
from lab.bench.stripe.truth import Cell
from lab.bench.stripe.truth import draw as drawn
from tests.support.recorded_scenes import RECORDED

HEIGHT, WIDTH = 480, 640
PHOTONS_ONLY = StripeSettings(speckle_contrast=0.0)


def draw(sigma: float, peak: float, seed: int = 0, slope: float = 0.02):
    return drawn(Cell(sigma, peak, slope=slope), (HEIGHT, WIDTH), seed)


@pytest.mark.parametrize(("sigma", "peak"), [(2, 600), (5, 800)])
def test_a_saturated_core_is_masked_not_believed(sigma, peak):
    image, centres = draw(sigma, peak)
    assert (image == 255).sum() > 2 * HEIGHT
    profile = extract(image, settings=PHOTONS_ONLY)
    assert profile.saturated.all()
    assert np.sqrt(np.mean((profile.centres - centres) ** 2)) < 0.02


def test_a_stripe_along_columns_is_that_along_rows_turned():
    image, _ = draw(2.0, 120)
    rows, columns = extract(image), extract(np.ascontiguousarray(image.T), axis="columns")
    np.testing.assert_array_equal(rows.centres, columns.centres)
    np.testing.assert_array_equal(rows.pixels(), columns.pixels()[:, ::-1])


def test_rows_without_a_stripe_are_gaps():
    image, _ = draw(2.0, 120)
    empty, _ = draw(2.0, 0.0, seed=3)
    image[100:200] = empty[100:200]
    profile = extract(image)
    assert not profile.valid[100:200].any()
    assert profile.valid[:100].all()
    assert profile.valid[200:].all()
    assert set(profile.rows) == set(range(480)) - set(range(100, 200))


def test_of_two_stripes_the_one_with_more_energy_is_taken_and_marked():
    strong, centres = draw(2.0, 120)
    # Higher but narrower: less energy.
    weak, _ = draw(1.0, 150, slope=0.0)
    image = np.maximum(strong, np.roll(weak, 150, axis=1))
    profile = extract(image)
    assert profile.double.mean() > 0.9
    assert np.nanmax(np.abs(profile.centres - centres)) < 0.5
    assert not extract(strong).double.any()


def test_a_dark_frame_takes_the_scenery_away():
    image, centres = draw(2.0, 100)
    scenery = np.zeros_like(image)
    scenery[:, 50:90] = 120
    lit = np.minimum(image.astype(int) + scenery, 255).astype(np.uint8)
    profile = extract(lit, dark=scenery)
    assert np.sqrt(np.nanmean((profile.centres - centres) ** 2)) < 0.05
    assert profile.valid.all()


def test_a_picture_without_a_stripe_has_no_centres():
    image, _ = draw(2.0, 0.0)
    assert not extract(image).valid.any()


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match="8-bit"):
        extract(np.zeros((480, 640), np.float32))
    with pytest.raises(ValueError, match="dark frame"):
        extract(np.zeros((480, 640), np.uint8), dark=np.zeros((10, 10), np.uint8))


@pytest.mark.recorded
@pytest.mark.parametrize("frame", [2, 3, 4, 5, 6, 7, 8])
def test_recorded_saturated_stripes_are_smooth(frame):
    path = RECORDED / "robot_line_laser" / f"frame{frame:04d}.png"
    if not path.exists():
        pytest.skip(f"recorded data are missing: {path} (set CELL_RECORDED_DATA)")
    profile = extract(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    assert profile.valid.mean() > 0.97
    roughness = np.diff(profile.centres[profile.valid], 2)
    # Second differences of independent errors scatter √6 times as much as the errors.
    assert np.median(np.abs(roughness)) / 0.6745 / np.sqrt(6) < 0.1
