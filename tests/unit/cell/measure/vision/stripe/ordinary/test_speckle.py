"""Promises of the stated deviations where the laser speckles, in single pictures and in streams."""

import numpy as np
import pytest

from cell.measure.vision.stripe.extract import BLOCK, StripeStream, extract
from lab.bench.stripe.campaign import measure
from lab.bench.stripe.truth import Cell, draw

SMALL = (256, 384)


@pytest.mark.parametrize("cell", [Cell(1.2, 100, 0.2), Cell(2, 100, 0.2), Cell(3, 60, 0.5)])
def test_the_stated_deviation_is_not_too_small_under_speckle(cell):
    row = measure(cell)
    assert row["stated_over_true"] > 0.95 and row["found"] > 0.98
    if cell.contrast < 0.3:
        assert row["efficiency"] > 0.85 and row["stated_over_true"] < 1.2


def test_in_a_stream_the_speckle_of_a_block_is_that_of_its_first_picture_with_a_stripe():
    dim = np.full(SMALL, 8, np.uint8)
    images = [draw(Cell(2, 120, contrast), SMALL, seed)[0] for seed, contrast in enumerate([0.2] * BLOCK + [0.1])]
    stream = StripeStream()
    profiles = [stream.extract(image) for image in (dim, *images)]
    assert profiles[0].speckle is None
    assert len({profile.speckle for profile in profiles[1:BLOCK]}) == 1
    assert profiles[BLOCK].speckle != profiles[1].speckle == extract(images[0]).speckle
    assert profiles[1].speckle.contrast == pytest.approx(0.2, abs=0.05)
    # The covered picture is without any noise, which must not be believed of the others.
    assert len({profile.noise for profile in profiles[1:BLOCK]}) == 1
    assert profiles[1].noise == extract(images[0]).noise != profiles[0].noise


def test_the_stated_deviation_is_true_with_the_speckle_of_an_earlier_picture():
    ratios = []
    for seed in range(3):
        stream = StripeStream()
        stream.extract(draw(Cell(2, 120, 0.2), (512, 384), 10 * seed)[0])
        for k in range(1, BLOCK, 2):
            image, centres = draw(Cell(2, 120, 0.2), (512, 384), 10 * seed + k)
            profile = stream.extract(image)
            ratios.append(np.sqrt(np.mean((profile.centres - centres) ** 2) / np.mean(profile.sigma**2)))
    assert 0.85 < np.mean(ratios) < 1.05
