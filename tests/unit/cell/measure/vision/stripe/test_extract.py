"""Promises of the stripe extraction, on pictures drawn from a formula; how near to its bound: `test_fit.py`."""

import numpy as np
import pytest

from cell.measure.vision.stripe.extract import KEPT_PX, around_stripe, extract
from lab.bench.stripe.truth import Cell, draw

SHAPE = (480, 640)


def test_a_stripe_along_columns_is_that_along_rows_turned():
    image, _ = draw(Cell(2.0, 120), SHAPE, 0)
    rows, columns = extract(image), extract(np.ascontiguousarray(image.T), axis="columns")
    np.testing.assert_array_equal(rows.centres, columns.centres)
    np.testing.assert_array_equal(rows.pixels(), columns.pixels()[:, ::-1])


def test_a_picture_without_a_stripe_has_no_centres():
    image, _ = draw(Cell(2.0, 0.0), SHAPE, 0)
    assert not extract(image).valid.any()


def test_a_picture_is_kept_around_its_stripe_where_that_tells_the_same():
    first, _ = draw(Cell(2.0, 120), SHAPE, 0)
    image, _ = draw(Cell(2.0, 120), SHAPE, 1)
    like = extract(first)
    profile = extract(image, like=like)
    kept = around_stripe(image, profile, like)
    assert np.count_nonzero(kept) <= (2 * KEPT_PX + 1) * len(image) < 0.2 * image.size
    np.testing.assert_array_equal(extract(kept, like=like).centres, profile.centres)
    # A reflection far from the stripe is seen in the whole picture alone.
    image[:, 80:84] = np.maximum(image[:, 80:84], 90)
    assert around_stripe(image, extract(image, like=like), like) is image


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match="8-bit"):
        extract(np.zeros((480, 640), np.float32))
    with pytest.raises(ValueError, match="dark frame"):
        extract(np.zeros((480, 640), np.uint8), dark=np.zeros((10, 10), np.uint8))
