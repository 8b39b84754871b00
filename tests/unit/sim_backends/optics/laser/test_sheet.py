"""Promises of the light sheet: what shades it, where it ends, how it bends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_backends.optics import CameraOptics, LaserOptics, PlaneInstance
from sim_backends.optics.laser.stripe import crossings
from tests.support.simulator.stripe_scene import CLEAN, FOCAL_PX, facing, stripe


def test_what_stands_in_the_sheet_takes_the_light_from_behind_it():
    floor = PlaneInstance(facing([0, 0, 0], 0.140), (0.2, 0.2), 0.5)
    in_the_sheet = facing([0, 0, 0], 0.060)
    in_the_sheet[0, 3] = -0.035 + 0.060 / 3.5
    image = stripe([floor, PlaneInstance(in_the_sheet, (0.010, 0.010), 0.5)]).sum(axis=1)
    assert (stripe([floor]).sum(axis=1) > 50).all()
    assert (image[230:250] < 1).all()
    assert (image[:60] > 50).all()


def test_a_laser_beside_the_camera_s_row_draws_two_peaks_under_a_ledge():
    # From 20 mm to the side the sheet reaches 3.3 mm under the ledge's rim, 20 mm above the floor at 140 mm.
    beside = replace(CLEAN, origin=(-0.035, -0.020, 0.0))
    floor = PlaneInstance(facing([0, 0, 0], 0.140), (0.2, 0.2), 0.5)
    over = facing([0, 0, 0], 0.120)
    over[:3, 3] += [-0.035 + 0.120 / 3.5, 0.010, 0.0]
    image = stripe([floor, PlaneInstance(over, (0.004, 0.020), 0.5)], beside)
    peaks = (image[:, 1:-1] > image[:, :-2]) & (image[:, 1:-1] >= image[:, 2:]) & (image[:, 1:-1] > 20)
    doubled = np.flatnonzero(peaks.sum(axis=1) == 2)
    assert len(doubled) == pytest.approx(0.020 * 0.020 / 0.120 / 0.140 * FOCAL_PX, abs=2)
    assert doubled[0] == pytest.approx(240, abs=1)


def test_the_fan_ends():
    narrow = replace(CLEAN, fan=np.deg2rad(3.0))
    light = stripe([PlaneInstance(facing([0, 0, 0], 0.130), (0.2, 0.2), 0.9)], narrow).sum(axis=1)
    half = np.tan(np.deg2rad(3.0)) * np.hypot(0.130, 0.130 / 3.5) / 0.130 * FOCAL_PX
    assert (light > 0).sum() == pytest.approx(2 * half, abs=4)


def test_a_bowed_sheet_is_seen_where_geometry_says() -> None:
    optics = CameraOptics(640, 480, 1667.0, 1667.0, 319.5, 239.5)
    wall = np.eye(4)
    wall[2, 3] = 0.130
    bow = 1e-4 * 0.13 / 0.018**2
    flat = crossings(optics, LaserOptics(), PlaneInstance(wall, (0.2, 0.2)))
    bent = crossings(optics, LaserOptics(bow=bow), PlaneInstance(wall, (0.2, 0.2)))
    # Across the optical axis, a sheet that is off by s along its normal meets the wall s / n_x to the side.
    laser = LaserOptics()
    along = np.hypot(0.130, 0.130 / 3.5)
    sag = bow * flat.points[:, 1] ** 2 / along
    assert bent.columns - flat.columns == pytest.approx(1667.0 / 0.130 * sag / laser.normal[0], abs=2e-3)
    assert sag.max() > 0.9e-4
