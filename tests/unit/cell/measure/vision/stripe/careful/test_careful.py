"""Promises of the stripe as workshops have it: other profiles, widths, texture, colour, depth, edges, second lines."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cell.measure.vision.stripe.careful.careful import fill_gaps, read_carefully
from cell.measure.vision.stripe.extract import extract
from cell.measure.vision.stripe.planes import LaserChannel, as_picture, read_colours
from cell.measure.vision.stripe.profile import StripeProfile, StripeSettings
from lab.bench.stripe.workshop import Scene, draw


def test_a_jpeg_is_read_with_a_true_deviation(tmp_path):
    image, centres = draw(Scene("Gaussian", 2.0, camera="red"), 3)
    cv2.imwrite(str(tmp_path / "laser.jpg"), image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    profile = extract(read_colours(tmp_path / "laser.jpg"))
    error = profile.centres - centres
    assert profile.valid.mean() > 0.99
    assert 0.6 < np.sqrt(np.nanmean(profile.sigma**2) / np.nanmean((error - np.nanmedian(error)) ** 2)) < 1.6


def line_of(width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line whose rows are `width` (rows,) px wide; its true centres."""
    rng = np.random.default_rng(1)
    row = np.arange(len(width))
    centres = 320 + 0.05 * (row - row.mean())
    height = 120 * np.sqrt(np.minimum(1.0, 2.0 / width))
    stripe = height[:, None] * np.exp(-0.5 * ((np.arange(640) - centres[:, None]) / width[:, None]) ** 2)
    noisy = rng.poisson((8 + stripe) * 40) / 40 + rng.normal(0, 0.4, stripe.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), centres


@pytest.mark.parametrize(
    "width",
    [np.linspace(1.5, 8, 480), np.linspace(2, 15, 480), np.repeat([1.0, 3.0, 9.0], 160)],
    ids=["1.5 to 8", "2 to 15", "1, 3, 9"],
)
def test_pieces_of_a_line_that_are_much_wider_or_narrower_than_the_rest_are_read(width):
    """Out of focus, on what shines: of these a tenth to a third was not found."""
    image, centres = line_of(width)
    profile = extract(image)
    error = profile.centres - centres
    assert np.isfinite(error).mean() > 0.98 and np.nanmax(np.abs(error)) < 0.7
    for piece in np.array_split(np.arange(480), 3):
        assert 0.4 < np.sqrt(np.nanmean((error / profile.sigma)[piece] ** 2)) < 1.25


def careful(centres: np.ndarray, light: float = 240.0) -> StripeProfile:
    """What the careful way found: a line 2 px wide."""
    seen = np.isfinite(centres)
    width, zero = np.where(seen, 2.0, np.nan), np.zeros(len(centres))
    deviations = {"sigma": 0.02 * width, "amplitude": 0.5 * light * width / 2, "width": width}
    flags = {"saturated": zero > 0, "double": zero > 0, "rival": zero, "misfit": width / 2}
    return StripeProfile("rows", centres.copy(), **deviations, **flags)


@pytest.mark.parametrize(
    ("piece", "taken"),
    [
        (lambda on: careful(on), True),
        (lambda on: careful(on, 100.0), True),
        (lambda on: careful(on + 5.0), False),
        (lambda on: careful(on, 20.0), False),
        (lambda on: careful(np.where(np.arange(len(on)) % 3 > 0, on, np.nan)), False),
    ],
    ids=["the line", "a darker part of it", "beside it", "a reflection", "specks"],
)
def test_a_gap_of_a_line_is_filled_only_with_the_same_line(piece, taken):
    centres = 320 + 0.05 * np.arange(480)
    line = careful(np.where(np.arange(480) < 330, centres, np.nan))
    asked = []

    def read(rows: slice) -> StripeProfile:
        asked.append(rows)
        return piece(centres[rows])

    fill_gaps(line, read)
    assert len(asked) == 1 and asked[0].start == pytest.approx(330, abs=6) and asked[0].stop == 480
    assert np.isfinite(line.centres[340:]).all() == taken
    assert np.isfinite(line.centres[:320]).all()


def test_where_little_of_a_picture_shows_a_line_nothing_is_added_to_it():
    line = careful(np.where(np.arange(480) < 140, 320.0, np.nan))
    fill_gaps(line, lambda rows: pytest.fail("read again"))


def test_a_line_is_looked_for_that_is_narrower_than_any_as_a_bright_column_of_the_sensor_teaches():
    image, _ = line_of(np.linspace(1.5, 8, 480))
    taught = extract(image).learned
    picture, narrow = as_picture(image, 250.0), replace(taught, scale=0.3)
    assert read_carefully(picture, None, LaserChannel.AUTO, StripeSettings(), like=narrow).valid.any()
