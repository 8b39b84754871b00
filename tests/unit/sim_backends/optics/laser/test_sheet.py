"""Promises of the light sheet: what shades it, where it ends, how it bends."""

from dataclasses import replace

import numpy as np
import pytest

from sim_backends.optics import CameraOptics, LaserOptics, MeshInstance, PlaneInstance
from sim_backends.optics.laser.sheet import HALO, HALO_AT, WET
from sim_backends.optics.laser.stripe import crossings
from sim_backends.optics.scene import Grain, Puddle
from tests.support.simulator.stripe_scene import CLEAN, FOCAL_PX, centroids, facing, height_field, stripe


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


def test_a_bowed_sheet_is_seen_where_geometry_says():
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


def test_oil_darkens_the_stripe_and_draws_its_centre_away_from_the_laser():
    puddle, flat = Puddle((0.002, 0.004), 0.007, 0.1e-3), height_field(lambda x, y: 0 * x)
    dry, wet = (MeshInstance(facing([0, 0, 0], 0.130), flat, 0.6, Grain(oil=oil)) for oil in (None, puddle))
    (before, light), (after, left) = centroids(stripe([dry])), centroids(stripe([wet]))
    where = crossings(CameraOptics(640, 480, FOCAL_PX, FOCAL_PX, 319.5, 239.5), CLEAN, dry)
    local = (where.points - dry.camera_from_mesh[:3, 3]) @ dry.camera_from_mesh[:3, :2]
    off = np.linalg.norm(local - puddle.centre, axis=1)
    outside, inside = where.rows[off > puddle.radius + 1e-3], where.rows[off < puddle.radius - 4e-3]
    assert len(outside) > 50 and len(inside) > 50
    assert after[outside] == pytest.approx(before[outside], abs=1e-6, nan_ok=True)
    assert left[outside] == pytest.approx(light[outside])
    assert left[inside] == pytest.approx(WET * (1.0 + HALO) * light[inside], rel=0.02)
    # The halo's share of the light, so far to the side as a film nearly as thick as in the middle puts it.
    most = HALO / (1.0 + HALO) * HALO_AT * puddle.thickness / CLEAN.normal[0] * FOCAL_PX / 0.130
    assert (after[inside] - before[inside] > 0.8 * most).all() and (after[inside] - before[inside] < most).all()
