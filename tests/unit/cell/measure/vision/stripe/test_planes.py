"""Promises of `cell.measure.vision.stripe.planes`."""

from __future__ import annotations

import numpy as np
import pytest

from cell.measure.vision.stripe.planes import as_picture, range_of


@pytest.mark.parametrize(
    ("bits", "shift", "full"), [(10, 0, 1023), (12, 0, 4095), (12, 4, 65520), (14, 2, 65532), (16, 0, 65535)]
)
def test_the_range_is_taken_from_the_values(bits, shift, full):
    values = np.random.default_rng(0).integers(0, 1 << bits, (64, 64)).astype(np.uint16)
    values[0, :2] = (1 << bits) - 1, 1
    assert range_of(values << shift) == full
    assert as_picture(values << shift).saturated[0, 0]
