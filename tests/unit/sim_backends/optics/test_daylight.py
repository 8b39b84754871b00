"""Daylight on the sensor: how bright, and how much of it a band-pass filter leaves."""

import pytest

from sim_backends.optics.daylight import LASER, laser_passed, share_passed


def test_a_filter_leaves_as_much_of_daylight_as_it_is_wide_and_the_laser_only_in_its_band():
    narrow, wide = (LASER, 10e-9, 0.9), (LASER, 40e-9, 0.9)
    assert share_passed((700e-9, 600e-9, 1.0)) == pytest.approx(1.0, abs=1e-3)
    assert share_passed(wide) == pytest.approx(4.0 * share_passed(narrow), rel=0.1)
    assert 0.01 < share_passed(narrow) < 0.03
    assert laser_passed(wide) == 0.9 and laser_passed((630e-9, 40e-9, 0.9)) == 0.0
