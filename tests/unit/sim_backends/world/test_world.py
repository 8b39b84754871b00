"""The whole world, without its peers: what couples the devices, and its truth."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sim_backends.world import drawing
from sim_backends.world.world import World, truth
from tests.support.simulator.standing_world import StandingWorld


def test_the_scan_camera_moves_along_the_rails_true_direction() -> None:
    world = StandingWorld("nominal")
    here = world.flange_from_camera("scan", 0.0)
    start = world.rail.carriage(0.0)
    moved = here[:3, 3] - world.scene.flange_from_scan_camera[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(start)
    assert here[:3, :3].T @ moved / start == pytest.approx(world.scene.rail_direction)


def test_the_arm_carries_laser_claw_and_grip_feedback_at_its_next_tick() -> None:
    world = StandingWorld()
    t = world.arm.time
    world.arm.tick(t + 0.01)
    assert world.part.held
    assert world.arm.digital_inputs & 1
    world.arm.write_digital_outputs(0b11, 0b01)
    world.arm.tick(t + 0.02)
    assert not world.part.held
    assert not world.arm.digital_inputs & 1
    assert not world.laser.at(t + 0.015)
    assert world.laser.at(t + 0.025)


def test_pressing_the_part_down_is_felt_upward_in_base_axes() -> None:
    world = StandingWorld()
    on_the_surface = drawing.inverse(world.base) @ world.scene.world_from_surface
    on_the_surface[2, 3] -= 0.0005
    wrench = world.arm.contact(on_the_surface @ drawing.inverse(drawing.FLANGE_FROM_PART))
    assert 5.0 < wrench[2] < 10.0


def test_the_body_leans_towards_where_the_arm_reaches() -> None:
    world = World(seed=2, level="nominal")
    world.arm.tick(0.5)
    world.vehicle.tick(0.6)
    reach = world.arm.base_from_flange(0.5)[:3, 3]
    up = world.vehicle.world_from_vehicle(0.6)[:3, 2]
    assert np.hypot(*up[:2]) > 0
    assert up[0] * reach[0] >= 0
    assert up[1] * reach[1] >= 0


def test_truth_is_complete_json_and_consistent() -> None:
    world = World(seed=9, level="nominal")
    told = json.loads(json.dumps(truth(world)))
    pose = {name: np.array(value) for name, value in told["poses"].items()}
    assert pose["world_from_base"] @ pose["base_from_surface"] == pytest.approx(pose["world_from_surface"])
    assert pose["base_from_flange"] @ pose["flange_from_part"] == pytest.approx(pose["base_from_part"])
    assert pose["base_from_surface"] @ pose["surface_from_part"] == pytest.approx(pose["base_from_part"])
    assert told["assumed_noise"]["speckle_contrast"]["sigma"] == 0.15
    assert told["part"]["held"]
    assert not told["laser_on"]
    assert told["vehicle"]["stopped"]
