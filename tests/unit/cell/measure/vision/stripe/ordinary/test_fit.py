"""Promises of the stripe's centres beside the Cramér–Rao bound, and of their stated deviations."""

import numpy as np
import pytest

from cell.measure.vision.stripe.extract import extract
from cell.measure.vision.stripe.profile import StripeSettings
from lab.bench.stripe.campaign import measure
from lab.bench.stripe.truth import Cell, bound, draw

SMALL = (256, 384)


@pytest.mark.parametrize(("cell", "published"), [(Cell(1.2, 40), 0.0304), (Cell(3, 200), 0.0156)])
def test_the_bound_is_the_published_one(cell, published):
    assert bound(cell, (480, 640)) == pytest.approx(published, rel=0.04)


@pytest.mark.parametrize("cell", [Cell(1.2, 40), Cell(2, 100), Cell(3, 220), Cell(2, 100, slope=0.15)])
def test_without_speckle_the_bound_is_attained_and_the_deviation_true(cell):
    row = measure(cell)
    assert row["efficiency"] >= 0.95 and abs(row["bias_px"]) < 0.005
    assert (row["stated_over_true"], row["found"]) == (pytest.approx(1.0, abs=0.1), 1.0)


def test_a_dark_frame_makes_the_deviation_larger_and_true():
    settings = StripeSettings(speckle_contrast=0.0)
    z = []
    for seed in range(4):
        image, centres = draw(Cell(2, 40, ambient=60), SMALL, seed)
        dark, _ = draw(Cell(2, 0.001, ambient=60), SMALL, 100 + seed)
        profile = extract(image, dark, settings=settings)
        assert np.nanmedian(profile.sigma) > 1.1 * np.nanmedian(extract(image, settings=settings).sigma)
        z.append((profile.centres - centres) / profile.sigma)
    assert np.sqrt(np.nanmean(np.square(z))) == pytest.approx(1.0, abs=0.1)
