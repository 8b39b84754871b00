"""Promises of `cell.apps.commission.checks.arm`."""

import numpy as np
import pinocchio as pin
import pytest

from cell.apps.commission.checks.arm import GRAVITY, weigh
from sim_backends.clock import SteppedClock
from sim_backends.models.arm import ArmModel, ArmParams


def test_what_is_carried_is_weighed_apart_from_the_sensors_zero():
    zero, mass, moment = np.array([3.0, -2.0, 5.0, 0.1, 0.2, -0.3]), 1.7, np.array([0.02, -0.01, 0.15])
    turns, wrenches = [], []
    for axis in ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.6, 0.0)):
        turn = np.asarray(pin.exp3(np.array(axis))) @ np.diag([1.0, -1.0, -1.0])
        down = np.array([0.0, 0.0, -GRAVITY])
        force, torque = mass * down, np.cross(turn @ moment, down)
        turns.append(turn)
        wrenches.append(np.concatenate([force + turn @ zero[:3], torque + turn @ zero[3:]]))
    found, arm, sigma = weigh(np.array(turns), np.array(wrenches))
    assert found == pytest.approx(mass)
    # Along the weight a centre of gravity cannot be felt in one posture; these postures differ.
    assert arm == pytest.approx(moment, abs=1e-9)
    assert sigma == pytest.approx(0.0, abs=1e-6)


def test_a_simulated_arm_feels_the_weight_that_it_was_not_told_of_and_takes_it_as_zero_when_asked():
    arm = ArmModel(ArmParams(carried=3.0, carried_centre=(0.0, 0.0, 0.1)), np.random.default_rng(1), SteppedClock())
    assert arm.felt == pytest.approx(np.zeros(6))
    arm.payload = (2.0, np.array([0.0, 0.0, 0.1]))
    flange = arm.reported_flange()[:3, :3]
    weight = np.array([0.0, 0.0, -9.81])
    assert arm.felt == pytest.approx([*weight, *np.cross(flange @ [0.0, 0.0, 0.1], weight)], abs=1e-9)
    arm.zero_force()
    assert arm.felt == pytest.approx(np.zeros(6))
