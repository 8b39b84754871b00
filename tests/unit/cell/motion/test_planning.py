"""Planned ways touch nothing, all along, and the same question gives the same way."""

import sys

import numpy as np
import pinocchio as pin
import pytest

from cell.motion import collision
from cell.motion.collision import CollisionError, CollisionModel, first_touch
from cell.motion.kinematics import ArmKinematics, Joints
from cell.motion.planning import EFFORTS, Planner
from cell.motion.trajectory import LineLimits, plan_joint
from tests.unit.cell.motion.conftest import DOWN, FLANGE_FROM_PART, RESTING, WORKING, assert_within, down, link_frames
from tests.unit.cell.motion.test_trajectory import fastest_point

FLANGE_FROM_TARGET = pin.SE3(pin.utils.rotate("z", np.pi / 2), np.array([-0.10, 0.0, 0.03]))
FLANGE_FROM_SCAN_MIDDLE = pin.SE3(pin.utils.rotate("z", np.pi / 2), np.array([0.09, 0.0, 0.08]))


def test_the_job_is_planned_without_touching_anything(planner: Planner):
    scan = planner.reach(down(0.75, -0.09, 0.26), WORKING, "scan")
    above = planner.reach(down(0.75, 0.0, 0.27), scan, "above the place")
    for motion in (planner.free(scan, above), planner.line(above, down(0.75, 0, 0.221), LineLimits(0.04), RESTING)):
        assert all(planner.collisions.free(q, RESTING) for q in motion.joints)
    with pytest.raises(CollisionError, match="part and surface"):
        planner.line(above, down(0.75, 0, 0.221), LineLimits(0.04))


WALL = collision.block("wall", collision.BASE, (0.45, -0.02, -0.3), (1.2, 0.02, 0.45))


def beside_wall(
    arm: ArmKinematics, x: float, y: float, *others: collision.Body
) -> tuple[CollisionModel, Planner, np.ndarray, np.ndarray]:
    """A model with the wall, its planner, and the arm to the left and to the right of it."""
    model = CollisionModel(arm, [*collision.arm_bodies(), *collision.tool_bodies(), WALL, *others])
    planner = Planner(arm, model)
    return model, planner, *(planner.reach(down(x, side, 0.25), WORKING, "beside") for side in (y, -y))


def test_an_obstacle_in_the_direct_way_is_avoided(arm: ArmKinematics):
    model, planner, left, right = beside_wall(arm, 0.7, 0.35)
    assert not all(model.free(q) for q in plan_joint(left, right, arm.limits).joints)
    motion = planner.free(left, right)
    assert all(model.free(q) for q in motion.joints)
    assert_within(motion, arm.limits)
    again = planner.free(left, right)
    assert np.array_equal(motion.joints, again.joints)


def test_a_slot_that_no_simple_detour_passes_is_searched(arm: ArmKinematics):
    roof = collision.block("roof", collision.BASE, (0.45, -0.6, 0.75), (1.2, 0.6, 0.80))
    model, planner, left, right = beside_wall(arm, 0.6, 0.30, roof)
    motion = planner.free(left, right)
    assert all(model.free(q) for q in motion.joints)


def test_without_ompl_ways_over_one_corner_are_tried_and_what_lacks_is_told(arm: ArmKinematics, monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)
    model, planner, left, right = beside_wall(arm, 0.7, 0.35)
    assert first_touch(model, np.stack([left, right])) is not None
    motion = planner.free(left, right)
    assert first_touch(model, motion.joints) is None
    assert np.array_equal(motion.joints, planner.free(left, right).joints)
    monkeypatch.setattr("cell.motion.planning.EFFORTS", EFFORTS[:1])
    monkeypatch.setattr(model, "free", lambda joints, allowed=(): not 0.0 < joints[0] - min(left[0], right[0]) < 1.0)
    with pytest.raises(
        CollisionError, match=r"over one corner.*ompl .*Python 3\.\d+.* wall would come closer than 5 mm"
    ):
        planner.free(left, right)


def test_an_end_that_touches_is_refused_by_name(planner: Planner):
    deep = planner.kinematics.ik(down(0.75, 0.2, 0.10), WORKING)
    with pytest.raises(CollisionError, match="the end of the motion"):
        planner.free(WORKING, deep)


def test_the_planners_moves_and_lines_keep_to_the_tool_speed(arm: ArmKinematics):
    model = CollisionModel(arm, collision.arm_bodies() + collision.tool_bodies((0.070, 0.036, 0.020), FLANGE_FROM_PART))
    planner = Planner(arm, model, tool_speed=0.25)
    free = planner.free(WORKING, WORKING + np.array([1.2, 0.1, -0.1, 0, 0, 0.5]))
    assert 0.2 < fastest_point(free, 800) <= 0.25
    start = arm.fk(WORKING)
    turned = pin.SE3(pin.utils.rotate("z", 0.8) @ start.rotation, start.translation + np.array([0.0, 0.1, 0.05]))
    assert fastest_point(planner.line(WORKING, turned, LineLimits(speed=0.25)), 800) <= 0.25 * 1.002
    shifted = pin.SE3(start.rotation, start.translation + np.array([0.0, 0.25, 0.0]))
    line = planner.line(WORKING, shifted, LineLimits(speed=0.25))
    assert fastest_point(line, 800) == pytest.approx(0.25, rel=2e-3), "a line that does not turn has its full speed"


def spheres(body: collision.Body, flange_frames: list[np.ndarray], step: float = 0.01) -> tuple[np.ndarray, float]:
    """Points (n, 3) in the base, no farther apart than `step`, that with the radius lie on the body's skin or core."""
    x, y, z = body.size
    if body.radius is not None:
        local = np.array([[0.0, 0.0, h] for h in np.linspace(-z / 2, z / 2, int(z / step) + 2)])
    else:
        axes = [np.linspace(-s / 2, s / 2, max(2, int(s / step) + 1)) for s in (x, y, z)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        local = grid[(np.abs(grid) >= np.array([x, y, z]) / 2 - 1e-9).any(axis=1)]
    pose = flange_frames[body.parent] @ body.placement.homogeneous
    return local @ pose[:3, :3].T + pose[:3, 3], body.radius or 0.0


def nearest_station_body(solids: list[collision.Body], joints: Joints) -> float:
    """Distance in m from what the arm moves to what stands, by points and boxes: never less than the true one."""
    frames, least = link_frames(joints), np.inf
    for obstacle in (b for b in solids if b.parent == collision.BASE and b.radius is None):
        inverse = np.linalg.inv(obstacle.placement.homogeneous)
        for body in (b for b in solids if b.parent > 2):
            points, radius = spheres(body, frames)
            outside = np.abs(points @ inverse[:3, :3].T + inverse[:3, 3]) - np.array(obstacle.size) / 2
            apart = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0)
            least = min(least, float(apart.min()) - radius)
    return least


def test_searched_ways_keep_five_millimetres_between_their_samples(planner: Planner, arm: ArmKinematics):
    over_the_deck = arm.ik(pin.SE3(DOWN, np.array([-0.6, 0.0, 0.35])), np.array([0.0, -1.25, 2.0, -2.3, -1.57, 2.8]))
    beside = planner.reach(down(0.75, -0.3, 0.25), WORKING, "beside")
    behind = planner.reach(down(0.68, 0.42, 0.30), WORKING, "behind the board")
    for start, end in ((beside, behind), (behind, over_the_deck)):
        motion = planner.free(start, end)
        way = motion.joints
        assert np.array_equal(way, planner.free(start, end).joints)
        dense = [a + f * (b - a) for a, b in zip(way[:-1:8], way[8::8], strict=False) for f in (0.0, 0.5)]
        solids = list(planner.collisions.bodies)
        assert min(nearest_station_body(solids, joints) for joints in dense[::4]) >= 0.005
