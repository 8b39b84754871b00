"""Daylight on the sensor: how bright, and how much of it a band-pass filter leaves."""

from __future__ import annotations

import pytest

from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.daylight import LASER, ROOMS_PER_KLX, laser_passed, share_passed
from sim_backends.optics.lighting import ambient_dn
from sim_backends.optics.scene import LaserOptics, Light


def test_a_room_is_some_hundred_lux_of_daylight_and_full_sun_three_hundred_rooms() -> None:
    assert 200.0 < 1000.0 / ROOMS_PER_KLX < 500.0
    white = ambient_dn(CameraOptics(1280, 1024, 1667.0, 1667.0, 639.5, 511.5), Light(100.0 * ROOMS_PER_KLX), 20e-6)
    assert 100.0 < white < 255.0


def test_a_filter_leaves_as_much_of_daylight_as_it_is_wide_and_the_laser_only_in_its_band() -> None:
    narrow, wide = (LASER, 10e-9, 0.9), (LASER, 40e-9, 0.9)
    assert share_passed((700e-9, 600e-9, 1.0)) == pytest.approx(1.0, abs=1e-3)
    assert share_passed(wide) == pytest.approx(4.0 * share_passed(narrow), rel=0.1)
    assert 0.01 < share_passed(narrow) < 0.03
    assert laser_passed(wide) == 0.9 and laser_passed((630e-9, 40e-9, 0.9)) == 0.0


def test_behind_20_nm_the_line_is_as_bright_as_a_third_of_full_sun() -> None:
    band = (LASER, 20e-9, 0.9)
    optics = CameraOptics(640, 480, 1667.0, 1667.0, 319.5, 239.5, transmission=share_passed(band))
    sun = ambient_dn(optics, Light(100.0 * ROOMS_PER_KLX), 1e-3)
    assert LaserOptics().brightness * laser_passed(band) * 1e-3 / sun == pytest.approx(0.36, rel=0.15)
