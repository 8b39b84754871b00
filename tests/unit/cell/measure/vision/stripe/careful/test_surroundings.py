"""Promises of `cell.measure.vision.stripe.careful.surroundings`."""

import numpy as np
import pytest

from cell.measure.vision.stripe.careful.surroundings import widen_what_departs
from cell.measure.vision.stripe.extract import extract
from lab.bench.stripe.truth import Cell, draw


def test_edges_ridges_and_clean_lines_keep_their_deviation():
    rng = np.random.default_rng(0)
    row = np.arange(480)
    for line in (0 * row, 30 * (row > 243), 2.0 * (row > 250), 0.3 * abs(row - 243), 20 * np.sin(row / 15)):
        sigma = np.full(480, 0.03)
        widen_what_departs(200 + line + rng.normal(0, 0.03, 480), sigma)
        assert np.count_nonzero(sigma > 0.03) <= 3


def spotted(cell: Cell, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A stripe in a picture with 60 stray spots of light; its true centres."""
    rng = np.random.default_rng(1000 + seed)
    image, centres = draw(cell, (480, 640), seed)
    row, column = np.mgrid[:480, :640]
    light = np.zeros(image.shape)
    for _ in range(60):
        at, size, peak, x = rng.uniform(0, 480), rng.uniform(0.7, 2.0), rng.uniform(20, 200), rng.uniform(0, 640)
        light += peak * np.exp(-0.5 * ((row - at) ** 2 + (column - x) ** 2) / size**2)
    return np.clip(np.round(image + rng.poisson(light * 40) / 40), 0, 255).astype(np.uint8), centres


def scores(cell: Cell, seeds: range) -> np.ndarray:
    """Errors over the stated deviations, among stray spots."""
    made = [(extract(image), centres) for image, centres in (spotted(cell, seed) for seed in seeds)]
    score = np.concatenate([(profile.centres - centres) / profile.sigma for profile, centres in made])
    assert np.isfinite(score).mean() > 0.99
    return score[np.isfinite(score)]


def test_a_spot_that_the_fit_absorbs_is_in_the_stated_deviation():
    """Spots lie 1 to 4 px beside the stripe: their lines fit, and are off by up to 2 px."""
    score = scores(Cell(2, 100), range(2))
    assert np.sqrt(np.mean(score**2)) < 1.3 and np.abs(score).max() < 5.0


@pytest.mark.campaign
@pytest.mark.parametrize("cell", [Cell(1.2, 100), Cell(2, 100), Cell(2, 100, 0.2), Cell(3, 100)])
def test_stray_spots_over_twenty_pictures(cell):
    score = scores(cell, range(20))
    print(f"{cell}: rms {np.sqrt(np.mean(score**2)):.2f}, worst {np.abs(score).max():.1f}, of {len(score)}")
    # Speckle by itself, with no spot in the line, comes to 5.3 once in twenty pictures.
    assert np.sqrt(np.mean(score**2)) < 1.3 and np.abs(score).max() < (6.0 if cell.contrast else 5.0)
