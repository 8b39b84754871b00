"""Promises of `cell.measure.inversion.observability`."""

import numpy as np
import pytest

from cell.measure.inversion import Tolerance
from cell.measure.inversion.observability import name as motion_name
from cell.measure.inversion.observability import sorted_out


def test_tolerances_must_be_sensible():
    with pytest.raises(ValueError, match="tolerances"):
        Tolerance(0.0, 0.006)


def test_a_screw_is_named_with_its_pitch():
    words = motion_name(np.array([0.0, 0.0, 0.02, 0.0, 0.0, 1.0]), 0.02)
    assert words == "rotation about the z axis of the surface frame with +20.0 mm/rad along it"


def test_motions_mixed_at_will_are_sorted_into_plain_ones():
    plain = np.zeros((6, 3))
    plain[0, 0] = plain[1, 1] = plain[5, 2] = 1.0
    mixed = plain @ np.array([[0.6, 0.3, 0.02], [-0.5, 0.8, 0.01], [20.0, 7.0, 30.0]])
    found = sorted_out(mixed, 0.02)
    expected = {0: 1.0, 1: 1.0, 5: 1.0}
    assert len(found) == 3
    for motion in found:
        assert motion.shape == (6,)
        axis = int(np.argmax(np.abs(motion)))
        assert abs(motion[axis]) == pytest.approx(expected.pop(axis), abs=1e-9)
        assert np.abs(np.delete(motion, axis)).max() < 1e-9
