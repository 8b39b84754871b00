"""Solid things stop each other in the simulated world, and the truth says what met what."""

import math

import numpy as np
import pinocchio as pin
import pytest

from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.described import Described
from cell.motion.collision import BASE, FLANGE, Body, arm_bodies, tool_bodies
from cell.motion.kinematics import ArmKinematics
from sim_backends.clock import SteppedClock
from sim_backends.models.arm import Safety
from sim_backends.models.arm_motion import JointMove, LinearMove
from sim_backends.models.vehicle import MOTOR_FAULT, ChassisState, Mode
from sim_backends.world import drawing as nominal
from sim_backends.world.bodies.collisions import BODIES, DECK, Collisions
from sim_backends.world.drawing import read
from sim_backends.world.world import World, truth
from tests.support.described_cells import described, pose

OVER_DECK = np.deg2rad([0.0, -100.0, 100.0, -90.0, -90.0, 0.0])


@pytest.fixture
def world() -> World:
    return World(seed=1, level="ideal", clock=SteppedClock())


def advance(world: World, seconds: float, speed: float = 0.0, yaw_rate: float = 0.0) -> None:
    """Let time pass; the vehicle is commanded all along when it has a speed."""
    end = world.clock.now() + seconds
    while (t := world.clock.now()) < end:
        if speed or yaw_rate:
            world.vehicle.command(t, speed, yaw_rate)
        world.clock.sleep(0.02)
        world.arm.tick(world.clock.now())
        world.vehicle.tick(world.clock.now())


def outline(world: World) -> np.ndarray:
    x, y, yaw = world.vehicle.planar(world.clock.now())
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    low, high = DECK[:, :2] + nominal.VEHICLE_FROM_BASE[:2, 3]
    corners = np.array([[high[0], high[1]], [high[0], low[1]], [low[0], low[1]], [low[0], high[1]]])
    return corners @ turn.T + [x, y]


def test_a_vehicle_that_drives_into_the_table_stays_before_it_and_reports_an_exception(world: World):
    world.vehicle.set_mode(0.0, Mode.CAN)
    advance(world, 10.0, speed=0.4)
    assert outline(world)[:, 0].max() == pytest.approx(-nominal.TABLE_HALF, abs=0.003)
    feedback = world.vehicle.feedback(world.clock.now())
    assert feedback.state is ChassisState.EXCEPTION
    assert feedback.errors & MOTOR_FAULT
    assert all(feedback.drivers)
    met = truth(world)["collisions"]
    assert [(row["body"], row["obstacle"]) for row in met] == [("vehicle", "table")]
    # From -3.05 m to -0.75 m: 0.4 m/s after 0.67 s of ramp.
    assert met[0]["time"] == pytest.approx(2.3 / 0.4 + 0.5 * 0.4 / 0.6, abs=0.05)


def test_a_vehicle_may_stand_a_millimetre_before_the_table_and_not_one_in_it(world: World):
    collisions = Collisions(world.scene, world.part)
    edge = -nominal.TABLE_HALF - 0.5
    assert not collisions.blocks(0.0, (edge - 0.001, 0.0, 0.0))
    assert collisions.blocks(0.0, (edge + 0.001, 0.0, 0.0))
    # Turned by 45° its corner reaches ahead: half a length and half a width, each by the cosine.
    corner = (0.5 + 0.4) * math.sqrt(0.5)
    assert not collisions.blocks(0.0, (-nominal.TABLE_HALF - corner - 0.001, 0.0, math.pi / 4))
    assert collisions.blocks(0.0, (-nominal.TABLE_HALF - corner + 0.001, 0.0, math.pi / 4))


def test_the_arm_that_is_sent_into_the_deck_stops_as_a_real_one_does_and_can_leave_it_unlocked(world: World):
    world.arm.start(JointMove(OVER_DECK, 1.0, 2.0))
    advance(world, 8.0)
    assert world.arm.safety is Safety.NORMAL
    up = world.arm.base_from_flange(world.clock.now()).copy()
    down = up.copy()
    down[2, 3] = -0.1
    world.arm.start(LinearMove(down, 0.1, 0.5))
    advance(world, 8.0)
    assert world.arm.safety is Safety.PROTECTIVE_STOP
    assert "hit the vehicle" in world.arm.fault_text
    assert {row["obstacle"] for row in truth(world)["collisions"]} == {"vehicle"}
    # Stopped where it hit: a look every 50 ms at 0.1 m/s, and braking.
    assert world.arm.base_from_flange(world.clock.now())[2, 3] > down[2, 3] + 0.05
    count = len(world.collisions.found)
    advance(world, world.arm.params.unlock_delay)
    world.arm.halt()
    assert world.arm.unlock()
    world.arm.start(LinearMove(up, 0.1, 0.5))
    advance(world, 10.0)
    assert world.arm.safety is Safety.NORMAL
    assert np.allclose(world.arm.base_from_flange(world.clock.now())[:3, 3], up[:3, 3], atol=1e-3)
    assert len(world.collisions.found) == count


def test_obstacles_of_configuration_and_job_are_solid(tmp_path):
    config, job = described(tmp_path)
    half_m = f"{500 * nominal.TABLE_HEIGHT:g}"
    config.write_text(
        config.read_text(encoding="utf-8") + '\n[[obstacle]]\nname = "rack"\nsize = ["400 mm", "100 mm", "400 mm"]\n'
        f"base_from_centre = {pose((-600.0, 260.0, 600.0), (0.0, 0.0, 0.0))}\n",
        encoding="utf-8",
    )
    job.write_text(
        job.read_text(encoding="utf-8") + '\n[[obstacle]]\nname = "fence"\n'
        f'size = ["100 mm", "1000 mm", "{half_m} mm"]\n'
        f"place_from_centre = {pose((-800.0, 0.0, -1.5 * float(half_m)), (0.0, 0.0, 0.0))}\n",
        encoding="utf-8",
    )
    drawing = read(Described.of(job).drawing(load_config(config)).as_json())
    world = World(seed=1, level="ideal", clock=SteppedClock(), drawing=drawing)
    world.arm.start(JointMove(OVER_DECK, 1.0, 2.0))
    advance(world, 8.0)
    aside = world.arm.base_from_flange(world.clock.now()).copy()
    aside[1, 3] += 0.4
    world.arm.start(LinearMove(aside, 0.1, 0.5))
    advance(world, 6.0)
    assert world.arm.safety is Safety.PROTECTIVE_STOP
    assert "hit the obstacle rack" in world.arm.fault_text
    world.vehicle.set_mode(0.0, Mode.CAN)
    advance(world, 10.0, speed=0.4)
    assert outline(world)[:, 0].max() == pytest.approx(-0.85, abs=0.003)
    assert {row["obstacle"] for row in truth(world)["collisions"]} == {"obstacle rack", "station obstacle fence"}


def test_no_point_of_the_worlds_arm_reaches_beyond_the_bodies_that_the_cell_plans_with(world: World):
    """Two descriptions of one arm, each from the maker's table; else a planned way could be a collision."""
    grasp = load_job("pot")[0].grasp
    bodies = [*arm_bodies(), *tool_bodies(grasp.size, grasp.flange_from_part.se3())]
    model = ArmKinematics().model
    data = model.createData()
    rng = np.random.default_rng(4)
    for _ in range(20):
        joints = rng.uniform(-2.0, 2.0, 6)
        pin.forwardKinematics(model, data, joints)
        base_from_joint6 = data.oMi[6].homogeneous
        base_from_flange = world.arm.kinematics.forward(joints)
        solid = world._solid
        points = solid.at(world.arm.kinematics.frames(joints), world.flange_from_camera("scan", 0.0), True)
        for point, body, radius in zip(points, solid.body, solid.radius, strict=True):
            room = max(inside(point, _pose(b, data, base_from_flange), b.size, b.radius) - radius for b in bodies)
            assert room > -0.002, BODIES[body]
        assert np.allclose(base_from_joint6[:3, 2], base_from_flange[:3, 2], atol=1e-9)


def _pose(body: Body, data: pin.Data, base_from_flange: np.ndarray) -> np.ndarray:
    if body.parent == BASE:
        return body.placement.homogeneous
    parent = base_from_flange if body.parent == FLANGE else data.oMi[body.parent].homogeneous
    return parent @ body.placement.homogeneous


def inside(point: np.ndarray, pose: np.ndarray, size: tuple[float, float, float], radius: float | None) -> float:
    """How deep a point is inside a box, or inside a capsule of `radius` about a segment of length size[2]; m."""
    local = (nominal.inverse(pose) @ [*point, 1.0])[:3]
    if radius is None:
        beyond = np.abs(local) - 0.5 * np.array(size)
        return float(-beyond.max()) if beyond.max() <= 0 else float(-np.linalg.norm(np.maximum(beyond, 0.0)))
    along = np.clip(local[2], -0.5 * size[2], 0.5 * size[2])
    return radius - float(np.linalg.norm(local - [0.0, 0.0, along]))
