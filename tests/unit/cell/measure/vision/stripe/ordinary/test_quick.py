"""Ordinary pictures: gaps, saturated cores, second peaks, and what is refused."""

import cv2
import numpy as np
import pytest

from cell.measure.vision.pictures import PictureRefused
from cell.measure.vision.stripe.extract import extract
from cell.measure.vision.stripe.profile import StripeSettings
from lab.bench.stripe.truth import Cell, draw
from tests.support.recorded_scenes import recording

SHAPE = (480, 640)
PHOTONS_ONLY = StripeSettings(speckle_contrast=0.0)
SMALL = (256, 384)


@pytest.mark.parametrize(("sigma", "peak"), [(2, 600), (5, 800)])
def test_a_saturated_core_is_masked_not_believed(sigma, peak):
    image, centres = draw(Cell(sigma, peak), SHAPE, 0)
    assert (image == 255).sum() > 2 * SHAPE[0]
    profile = extract(image, settings=PHOTONS_ONLY)
    assert profile.saturated.all()
    assert np.sqrt(np.mean((profile.centres - centres) ** 2)) < 0.02


def test_rows_without_a_stripe_are_gaps():
    image, _ = draw(Cell(2.0, 120), SHAPE, 0)
    empty, _ = draw(Cell(2.0, 0.0), SHAPE, 3)
    image[100:200] = empty[100:200]
    profile = extract(image)
    assert set(profile.rows) == set(np.flatnonzero(profile.valid)) == set(range(480)) - set(range(100, 200))


def test_of_two_stripes_the_one_with_more_energy_is_taken_and_marked():
    strong, centres = draw(Cell(2.0, 120), SHAPE, 0)
    # Higher but narrower: less energy.
    weak, _ = draw(Cell(1.0, 150, slope=0.0), SHAPE, 0)
    image = np.maximum(strong, np.roll(weak, 150, axis=1))
    profile = extract(image)
    assert profile.double.mean() > 0.9
    assert np.nanmax(np.abs(profile.centres - centres)) < 0.5
    assert not extract(strong).double.any()


@pytest.mark.recorded
@pytest.mark.parametrize("frame", [2, 3, 4, 5, 6, 7, 8])
def test_recorded_saturated_stripes_are_smooth(frame):
    path = recording("robot_line_laser") / f"frame{frame:04d}.png"
    profile = extract(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    assert profile.valid.mean() > 0.97
    roughness = np.diff(profile.centres[profile.valid], 2)
    # Second differences of independent errors scatter √6 times as much as the errors.
    assert np.median(np.abs(roughness)) / 0.6745 / np.sqrt(6) < 0.1


def test_where_a_reflection_is_brighter_the_neighbours_say_which_is_the_stripe():
    image, centres = draw(Cell(2, 80), SMALL, 2)
    other, _ = draw(Cell(2, 160), SMALL, 3)
    for row in range(20, 240, 12):
        image[row, 40:90] = np.roll(other[row], 65 - int(other[row].argmax()))[40:90]
    profile = extract(image)
    assert np.nanmax(np.abs(profile.centres - centres)) < 0.5
    assert profile.double[20:240:12].all()


def test_peaks_that_jump_from_line_to_line_have_a_centre_and_a_deviation():
    rng = np.random.default_rng(0)
    column = np.arange(640)
    centres = 20.0 + (97 * np.arange(400)) % 600
    light = 8 + 120 * np.exp(-0.5 * ((column - centres[:, None]) / 1.3) ** 2)
    image = np.clip(rng.normal(light * rng.lognormal(0, 0.2, light.shape), 1), 0, 255).astype(np.uint8)
    profile = extract(image)
    assert profile.valid.mean() > 0.9
    assert np.sqrt(np.nanmean((profile.centres - centres) ** 2)) < 0.2
    assert np.nanmin(profile.sigma) > 0.01


def test_a_blinded_picture_is_refused():
    with pytest.raises(PictureRefused, match="saturated"):
        extract(np.full((480, 640), 255, np.uint8))
