"""The simulated vehicle's physics against closed forms."""

import math
from typing import Any

import numpy as np
import pytest

from sim_backends.models.vehicle import ChassisState, Mode, VehicleModel, VehicleParams


def vehicle(seed: int = 1, **params: Any) -> VehicleModel:
    return VehicleModel(VehicleParams(**params), np.random.default_rng(seed))


def drive(model: VehicleModel, begin: float, end: float, speed: float, yaw_rate: float = 0.0) -> None:
    for t in np.arange(begin, end - 1e-9, 0.02):
        model.command(float(t), speed, yaw_rate)
    model.tick(end)


def test_one_that_is_bumped_into_stands_elsewhere_and_its_wheels_do_not_tell():
    model = vehicle()
    model.push(1.0, 0.01, -0.02, 0.003)
    assert model.planar(1.0) == pytest.approx((-3.04, -0.02, 0.003))
    assert (model.feedback(1.0).left, model.feedback(1.0).right, model.feedback(1.0).speed) == (0.0, 0.0, 0.0)
    assert model.world_from_vehicle(1.0)[:2, 3] == pytest.approx((-3.04, -0.02))


def test_slip_is_seen_by_the_world_and_not_by_the_odometers():
    model = vehicle(distance_scale=1.03, yaw_scale=0.9)
    model.set_mode(0.0, Mode.CAN)
    drive(model, 0.0, 5.0, 0.3)
    model.tick(10.0)
    feedback, (x, y, yaw) = model.feedback(10.0), model.planar(10.0)
    assert (x + 3.05) / feedback.left == pytest.approx(1.03)
    assert (y, yaw, feedback.right) == pytest.approx((0.0, 0.0, feedback.left))
    drive(model, 10.0, 14.0, 0.0, 0.3)
    model.tick(20.0)
    turned = (model.feedback(20.0).right - model.feedback(20.0).left) / model.params.track
    assert model.planar(20.0)[2] == pytest.approx(0.9 * turned)
    assert turned > 1.0


def test_the_random_walk_grows_with_the_root_of_the_way():
    headings = []
    for seed in range(30):
        model = vehicle(seed, yaw_walk=0.01)
        model.set_mode(0.0, Mode.CAN)
        drive(model, 0.0, 4.0, 0.5)
        headings.append(model.planar(10.0)[2])
    way = model.feedback(10.0).left
    assert np.std(headings) == pytest.approx(0.01 * math.sqrt(way), rel=0.3)


def test_the_pose_is_known_between_ticks_and_carries_the_sag():
    model = vehicle(start=(1.0, 2.0, math.pi / 2))
    model.sag = lambda: (0.01, 0.02, -0.003)
    model.tick(1.0)
    pose = model.world_from_vehicle(1.0)
    np.testing.assert_allclose(pose[:3, 3], [1.0, 2.0, -0.003])
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    # Pitch about the body's y axis, which is world −x here, lowers the nose; roll about its x axis lifts its left side.
    assert pose[2, 0] == pytest.approx(-math.sin(0.02))
    assert pose[2, 1] == pytest.approx(math.cos(0.02) * math.sin(0.01))
    model.set_mode(1.0, Mode.CAN)
    drive(model, 1.0, 3.0, 0.2)
    early, late = model.world_from_vehicle(2.0), model.world_from_vehicle(2.01)
    assert late[1, 3] - early[1, 3] == pytest.approx(0.002, rel=0.01)


def test_brake_and_emergency_stop_stop_hard_and_hold():
    for act in ("brake", "emergency"):
        model = vehicle(brake_deceleration=2.5)
        model.set_mode(0.0, Mode.CAN)
        drive(model, 0.0, 2.0, 0.5)
        x = model.planar(2.0)[0]
        if act == "brake":
            model.set_brake(2.0, True)
        else:
            model.fault("vehicle.emergency_stop", 2.0)
        drive(model, 2.0, 4.0, 0.5)
        assert model.planar(4.0)[0] - x == pytest.approx(0.5**2 / (2 * 2.5), abs=2e-3)
        model.clear_errors(4.0)
        assert model.feedback(4.0).state is (ChassisState.OK if act == "brake" else ChassisState.EMERGENCY_STOP)
        model.set_brake(4.0, False)
        model.clear(4.0)
        drive(model, 4.0, 5.0, 0.5)
        assert model.feedback(5.0).speed > 0.4
