"""The whole world, without its peers: what couples the devices, and its truth."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sim_backends.clock import SteppedClock
from sim_backends.world import drawing
from sim_backends.world.world import World, truth
from tests.support.simulator.standing_world import StandingWorld


def test_the_scan_camera_moves_along_the_rails_true_direction():
    world = StandingWorld("nominal")
    here = world.flange_from_camera("scan", 0.0)
    start = world.rail.carriage(0.0)
    moved = here[:3, 3] - world.scene.flange_from_scan_camera[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(start)
    assert here[:3, :3].T @ moved / start == pytest.approx(world.scene.rail_direction)


def test_the_arm_carries_laser_claw_and_grip_feedback_at_its_next_tick():
    world = StandingWorld()
    t = world.arm.time
    world.arm.tick(t + 0.01)
    assert world.part.held
    assert world.arm.digital_inputs & 1
    world.arm.write_digital_outputs(0b11, 0b01)
    world.arm.tick(t + 0.02)
    assert not world.part.held
    assert not world.arm.digital_inputs & 1
    assert not world.laser.at(t + 0.015) and world.laser.at(t + 0.025)


def test_pressing_the_part_down_is_felt_upward_in_base_axes():
    world = StandingWorld()
    on_the_surface = drawing.inverse(world.base) @ world.scene.world_from_surface
    on_the_surface[2, 3] -= 0.0005
    wrench = world.arm.contact(on_the_surface @ drawing.inverse(drawing.FLANGE_FROM_PART))
    assert 5.0 < wrench[2] < 10.0


def test_a_surface_that_is_pushed_lies_elsewhere_and_is_touched_there():
    world = StandingWorld()
    before = world.scene.world_from_surface.copy()
    by = np.eye(4)
    by[0, 3] = 0.01
    world.slide(by)
    assert world.scene.world_from_surface == pytest.approx(before @ by)
    assert world.part.held
    pressed = by.copy()
    pressed[2, 3] = -0.0005
    there = drawing.inverse(world.base) @ before @ pressed @ drawing.inverse(drawing.FLANGE_FROM_PART)
    assert 5.0 < world.arm.contact(there)[2] < 10.0


def test_the_body_leans_towards_where_the_arm_reaches():
    world = World(seed=2, level="nominal")
    world.arm.tick(0.5)
    world.vehicle.tick(0.6)
    reach = world.arm.base_from_flange(0.5)[:3, 3]
    up = world.vehicle.world_from_vehicle(0.6)[:3, 2]
    assert np.hypot(*up[:2]) > 0
    assert up[0] * reach[0] >= 0
    assert up[1] * reach[1] >= 0


def test_truth_is_complete_json_and_consistent():
    world = World(seed=9, level="nominal")
    told = json.loads(json.dumps(truth(world)))
    pose = {name: np.array(value) for name, value in told["poses"].items()}
    assert pose["world_from_base"] @ pose["base_from_surface"] == pytest.approx(pose["world_from_surface"])
    assert pose["base_from_flange"] @ pose["flange_from_part"] == pytest.approx(pose["base_from_part"])
    assert pose["base_from_surface"] @ pose["surface_from_part"] == pytest.approx(pose["base_from_part"])
    assert told["assumed_noise"]["speckle_contrast"]["sigma"] == 0.15
    assert told["part"]["held"] and not told["laser_on"] and told["vehicle"]["stopped"]


def test_the_items_of_a_job_stand_on_one_table_each_with_its_part_until_that_was_taken():
    def at(x: float, y: float, z: float) -> np.ndarray:
        return drawing.pose((x, y, z), (1, 0, 0), (0, 0, 1))

    nests = [at(-0.6, y, 0.03) for y in (0.0, 0.1)]
    beside = tuple(
        replace(drawing.STOCK.station, nest=nest, nest_filled=True, place_from_surface=at(0.0, y, 0.0))
        for nest, y in zip(nests, (-0.06, 0.06), strict=True)
    )
    first, second = (replace(drawing.STOCK, station=replace(each, beside=beside)) for each in beside)
    assert drawing.read(second.as_json()).as_json() == second.as_json()
    world = World(3, "nominal", drawing=first, clock=SteppedClock())
    for item, drawn in zip(world._items, beside, strict=True):
        scene = item.scene
        np.testing.assert_allclose(
            drawing.inverse(scene.world_from_table) @ scene.world_from_surface, drawn.place_from_surface, atol=1e-15
        )
        lies = drawing.inverse(world.world_from_base(0.0)) @ item.part.part_pose(np.eye(4))
        assert 1e-5 < np.linalg.norm((lies - drawn.nest)[:3, 3]) < 2e-3 and not item.part.held  # type: ignore[operator]
    assert world.part is world._items[0].part
    world.make_ready(second.station)
    assert (world.part is world._items[1].part, world.parts, world.scene) == (True, 0, world._items[1].scene)
    flange = world._items[0].part.part_pose(np.eye(4)) @ drawing.inverse(drawing.FLANGE_FROM_PART)
    for closed in (True, False):
        for item in world._items:
            item.part.set_claw(closed, flange)
        held = [item.part.held for item in world._items]
        assert held == [closed, False]
        assert world.part is world._items[0 if closed else 1].part, "the one that is held counts"
    world.make_ready(second.station)
    assert world.parts == 0, "the second one lies as it lay"
    world.make_ready(first.station)
    assert world.parts == 2 and world._items[0].part.untouched, "the first one was taken: all is made ready again"


def test_two_stations_stand_in_one_world_each_with_its_board_and_what_it_is_off_by():
    there = drawing.pose((-2.75, -2.75, 0.0), (0, -1, 0), (0, 0, 1))
    nest = drawing.pose((-0.6, 0.0, 0.03), (1, 0, 0), (0, 0, 1))
    own = replace(drawing.STOCK.station, nest=nest, nest_filled=True, stop="left")
    other = replace(own, stop="right", place_from_stop=there, board="marked_dots:11x9:16mm")
    left, right = (replace(drawing.STOCK, station=replace(each, beside=(own, other))) for each in (own, other))
    assert drawing.read(right.as_json()).as_json() == right.as_json()
    world = World(3, "nominal", drawing=left, clock=SteppedClock())
    first, second = (item.scene for item in world._items)
    off = drawing.inverse(there) @ drawing.inverse(first.world_from_place) @ second.world_from_place
    assert 1e-3 < np.linalg.norm(off[:3, 3]) < 0.08 and abs(off[2, 3]) < 1e-12 and off[2, 2] == 1.0
    board = drawing.inverse(second.world_from_place) @ second.world_from_board
    np.testing.assert_allclose(board, drawing.PLACE_FROM_BOARD, atol=1e-12)

    def stands(station: int) -> bool:
        x, y = (first, second)[station].world_from_table[:2, 3]
        return world.collisions.blocks(0.0, (float(x), float(y), 0.0))

    def shown(station: int) -> np.ndarray:
        facing = (first, second)[station].world_from_board @ drawing.pose((0.08, 0.06, -0.9), (1, 0, 0), (0, 0, 1))
        return world._cameras.picture("target", facing, np.eye(4), False, 0.01)

    assert stands(0) and stands(1) and world.collisions.found[1].obstacle == "table of stop right"
    assert shown(0).std() > 20 and shown(1).std() > 20
    world.make_ready(right.station)
    assert (world.scene, world.parts) == (second, 0), "both were there all along"
    assert stands(0) and stands(1) and shown(0).std() > 20
