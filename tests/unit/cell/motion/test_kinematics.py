"""The arm reaches what it should, touches nothing it must not, and moves within its limits.

Arms of every model, as drawn and as calibrated in the factory: against the vendor's description and real tables."""

from __future__ import annotations

import struct
import sys

import numpy as np
import pinocchio as pin
import pytest

from cell.motion import collision
from cell.motion.collision import CollisionError, CollisionModel, arm_bodies, first_touch
from cell.motion.kinematics import (
    MODELS,
    ArmKinematics,
    DenavitHartenberg,
    JointLimits,
    Joints,
    Unreachable,
    arm_kinematics,
    kinematics_name,
)
from cell.motion.planning import EFFORTS, Planner
from cell.motion.trajectory import (
    LineLimits,
    PointSpeed,
    SingularLine,
    Trajectory,
    carried_points,
    join,
    plan_joint,
    plan_line,
)
from drivers.arm.factory import parse_kinematics_info
from drivers.errors import ConfigError, RefusedError
from drivers.interfaces import LinkTable
from sim_backends.models.arm_kinematics import TABLES, Kinematics

WORKING = np.array([2.8, -1.25, 2.0, -2.3, -1.57, 2.8])
"""Posture over the placement area: tool down, elbow up."""
DOWN = np.column_stack([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Rotation of a tool that points down with its y axis along the base's x axis."""
BASE_FROM_PLACE = pin.SE3(np.eye(3), np.array([0.75, 0.0, 0.05]))
_C = np.sqrt(0.5)
PLACE_FROM_BOARD_CENTRE = pin.SE3(
    np.column_stack([[0.0, -1.0, 0.0], [-_C, 0.0, -_C], [_C, 0.0, -_C]]), np.array([0.10, 0.32, 0.12])
)
FLANGE_FROM_PART = pin.SE3(DOWN, np.array([0.0, 0.0, 0.17]))
FLANGE_FROM_TARGET = pin.SE3(pin.utils.rotate("z", np.pi / 2), np.array([-0.10, 0.0, 0.03]))
FLANGE_FROM_SCAN_MIDDLE = pin.SE3(pin.utils.rotate("z", np.pi / 2), np.array([0.09, 0.0, 0.08]))
RESTING = [("part", "surface"), ("part", "table")]


def down(x: float, y: float, z: float) -> pin.SE3:
    return pin.SE3(DOWN, np.array([x, y, z]))


def independent_fk(joints: Joints) -> np.ndarray:
    """The maker's table multiplied out with plain matrices, without Pinocchio."""
    table, pose = DenavitHartenberg(), np.eye(4)
    for q, d, a, alpha in zip(joints, table.d, table.a, table.alpha, strict=True):
        c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        pose = pose @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return pose


@pytest.fixture(scope="module")
def arm() -> ArmKinematics:
    return ArmKinematics()


@pytest.fixture(scope="module")
def planner(arm: ArmKinematics) -> Planner:
    solids = collision.arm_bodies() + collision.tool_bodies((0.070, 0.036, 0.020), FLANGE_FROM_PART)
    face_up = np.diag([1.0, -1.0, -1.0])
    plates = [
        ("fine plate", pin.SE3(face_up, np.array([-0.55, 0.25, 0.01])), (0.042, 0.036, 0.02)),
        ("large plate", pin.SE3(face_up, np.array([-0.60, -0.25, 0.01])), (0.21, 0.17, 0.02)),
    ]
    solids += collision.vehicle_bodies(plates) + collision.station_bodies(BASE_FROM_PLACE, PLACE_FROM_BOARD_CENTRE)
    return Planner(arm, CollisionModel(arm, solids))


# --- kinematics ---


def test_forward_kinematics_is_the_makers_table(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(1)
    for joints in rng.uniform(-np.pi, np.pi, (50, 6)):
        assert np.allclose(arm.fk(joints).homogeneous, independent_fk(joints), atol=1e-12)


def test_every_reachable_pose_is_reached_exactly_and_on_the_branch_asked_for(arm: ArmKinematics) -> None:
    rng = np.random.default_rng(2)
    for joints in rng.uniform(-2.9, 2.9, (60, 6)):
        pose = arm.fk(joints)
        near = arm.ik(pose, joints + rng.normal(0, 0.02, 6))
        assert np.allclose(independent_fk(near), pose.homogeneous, atol=1e-9)
        if arm.manipulability(joints) > 0.05:
            assert np.allclose(near, joints, atol=1e-6)


def test_all_eight_branches_over_the_placement_area_are_found(arm: ArmKinematics) -> None:
    found = arm.solutions(down(0.75, 0.0, 0.22), WORKING)
    assert len(found) == 8
    assert [float(np.sum((q - WORKING) ** 2)) for q in found] == sorted(
        float(np.sum((q - WORKING) ** 2)) for q in found
    )


def test_an_arm_whose_links_deviate_from_the_table_is_still_solved_exactly() -> None:
    table = DenavitHartenberg()
    off = DenavitHartenberg(
        d=(0.1812, 0.0003, -0.0002, 0.1738, 0.1201, 0.1163),
        a=(0.0002, -0.6131, -0.5711, 0.0003, 0.0, 0.0),
        alpha=(table.alpha[0] + 5e-4, 3e-4, -4e-4, table.alpha[3] - 6e-4, table.alpha[4] + 2e-4, 0.0),
    )
    arm = ArmKinematics(off)
    pose = down(0.75, 0.1, 0.25)
    assert np.linalg.norm(pin.log6(arm.fk(arm.ik(pose, WORKING)).actInv(pose)).vector) < 1e-7


def test_a_pose_out_of_reach_is_refused_with_the_distance(arm: ArmKinematics) -> None:
    with pytest.raises(Unreachable, match=r"out of reach.*stays \d{2,4}\.\d mm"):
        arm.ik(down(1.9, 0.0, 0.3), WORKING)


def test_joint_ranges_are_kept(arm: ArmKinematics) -> None:
    tight = ArmKinematics(limits=JointLimits(lower=(-np.pi,) * 6, upper=(np.pi,) * 6))
    for joints in tight.solutions(down(0.75, 0.0, 0.22), np.full(6, 3.1)):
        assert np.all(np.abs(joints) <= np.pi)


@pytest.mark.parametrize("bad", [{"speed": (0.0,) * 6}, {"jerk": (1.0,) * 5}, {"lower": (7.0,) * 6}])
def test_limits_that_make_no_sense_are_refused(bad: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(ValueError, match="joint"):
        JointLimits(**bad)


# --- the cell's layout ---


def test_scan_place_and_photo_postures_are_free(planner: Planner) -> None:
    board = BASE_FROM_PLACE * PLACE_FROM_BOARD_CENTRE
    photo = pin.SE3(board.rotation, board.translation - 0.95 * board.rotation[:, 2]) * FLANGE_FROM_TARGET.inverse()
    for name, pose in {"scan": down(0.75, -0.09, 0.26), "above": down(0.75, 0, 0.30), "photo": photo}.items():
        joints = planner.reach(pose, WORKING, name)
        assert planner.kinematics.manipulability(joints) > 0.1


def test_calibration_postures_over_the_fine_plate_are_free(planner: Planner) -> None:
    face_up = np.diag([1.0, -1.0, -1.0])
    for tilt_x, tilt_y in [(0, 0), (20, 0), (-20, 0), (0, 20), (0, -20)]:
        tilt = pin.utils.rotate("x", np.radians(tilt_x)) @ pin.utils.rotate("y", np.radians(tilt_y))
        rotation = face_up @ tilt
        camera = pin.SE3(rotation, np.array([-0.55, 0.25, 0.02]) - 0.13 * rotation[:, 2])
        planner.reach(camera * FLANGE_FROM_SCAN_MIDDLE.inverse(), WORKING, f"tilt {tilt_x}, {tilt_y}")


def test_a_posture_in_the_table_names_what_touches(planner: Planner) -> None:
    with pytest.raises(CollisionError, match=r"deep: .*table"):
        planner.reach(down(0.75, 0.2, 0.10), WORKING, "deep")


def test_the_part_may_touch_the_surface_only_where_allowed(planner: Planner) -> None:
    resting = planner.kinematics.ik(down(0.75, 0.0, 0.222), WORKING)
    assert ("part", "surface") in planner.collisions.touching(resting)
    assert planner.collisions.touching(resting, RESTING) == []


def test_distance_to_the_table_is_the_height_above_it(planner: Planner) -> None:
    joints = planner.kinematics.ik(down(0.75, -0.3, 0.05 + 0.17 + 0.012), WORKING)
    distance, pair = planner.collisions.distance(joints)
    assert set(pair) == {"part", "table"}
    assert distance == pytest.approx(0.014, abs=1e-6)


# --- trajectories ---


def assert_within(trajectory: Trajectory, limits: JointLimits) -> None:
    """Finite differences of the samples against the limits."""
    dt = np.diff(trajectory.times)[:, None]
    speed = np.diff(trajectory.joints, axis=0) / dt
    acceleration = np.diff(speed, axis=0) / dt[1:]
    jerk = np.diff(acceleration, axis=0) / dt[2:]
    for name, values in {"speed": speed, "acceleration": acceleration, "jerk": jerk}.items():
        assert np.all(np.abs(values).max(axis=0) <= np.array(getattr(limits, name)) * 1.001), name


def test_a_joint_move_is_jerk_limited_and_rests_at_both_ends() -> None:
    limits, start, end = JointLimits(), np.zeros(6), np.array([1.5, -1.0, 0.5, -2.0, 0.1, 0.0])
    motion = plan_joint(start, end, limits, period=0.002)
    assert_within(motion, limits)
    assert np.array_equal(motion.start, start)
    assert np.array_equal(motion.end, end)
    assert np.abs(motion.speeds()[[0, -1]]).max() < 1e-3


def test_half_the_speed_takes_twice_as_long() -> None:
    end = np.array([2.0, 0, 0, 0, 0, 0])
    full, half = (plan_joint(np.zeros(6), end, JointLimits().scaled(f)).duration for f in (1.0, 0.5))
    assert half == pytest.approx(2 * full, rel=1e-6)


def test_a_move_to_where_the_arm_stands_is_a_motion_of_one_period() -> None:
    motion = plan_joint(WORKING, WORKING, JointLimits())
    assert motion.duration > 0
    assert np.array_equal(motion.start, motion.end)


def test_a_joint_move_out_of_range_is_refused() -> None:
    with pytest.raises(RefusedError, match="outside the ranges"):
        plan_joint(np.zeros(6), np.array([0, 0, 4.0, 0, 0, 0]), JointLimits())


def test_a_line_is_straight_and_turns_evenly(arm: ArmKinematics) -> None:
    start = arm.ik(down(0.70, -0.1, 0.35), WORKING)
    a = arm.fk(start)
    b = pin.SE3(DOWN @ pin.utils.rotate("z", 0.3), np.array([0.80, 0.10, 0.25]))
    motion = plan_line(arm, start, b, LineLimits(speed=0.2))
    way = b.translation - a.translation
    for joints in motion.joints[::5]:
        pose = independent_fk(joints)
        s = float((pose[:3, 3] - a.translation) @ way / (way @ way))
        assert np.linalg.norm(pose[:3, 3] - a.translation - s * way) < 1e-8
        assert np.linalg.norm(pin.log3(a.rotation.T @ pose[:3, :3])) == pytest.approx(0.3 * s, abs=1e-6)
    flange = np.array([independent_fk(q)[:3, 3] for q in motion.joints])
    assert np.linalg.norm(np.diff(flange, axis=0), axis=1).max() / 0.008 <= 0.2 * 1.001
    assert np.all(np.abs(motion.speeds()) <= np.array(arm.limits.speed))


def test_a_line_through_a_singular_posture_is_refused(arm: ArmKinematics) -> None:
    start = np.array([0.0, -1.2, 1.8, -2.1, -0.3, 0.0])
    end = np.array([0.0, -1.2, 1.8, -2.1, 0.3, 0.0])
    with pytest.raises((SingularLine, Unreachable)):
        plan_line(arm, start, arm.fk(end))


def test_motions_join_only_where_they_meet() -> None:
    a = plan_joint(np.zeros(6), np.full(6, 0.1), JointLimits())
    b = plan_joint(np.full(6, 0.1), np.full(6, -0.1), JointLimits())
    both = join([a, b])
    assert both.duration == pytest.approx(a.duration + b.duration)
    assert np.all(np.diff(both.times) > 0)
    with pytest.raises(ValueError, match="starts"):
        join([b, b])


# --- planning ---


def test_the_job_is_planned_without_touching_anything(planner: Planner) -> None:
    scan = planner.reach(down(0.75, -0.09, 0.26), WORKING, "scan")
    above = planner.reach(down(0.75, 0.0, 0.27), scan, "above the place")
    for motion in (planner.free(scan, above), planner.line(above, down(0.75, 0, 0.221), LineLimits(0.04), RESTING)):
        assert all(planner.collisions.free(q, RESTING) for q in motion.joints)
    with pytest.raises(CollisionError, match="part and surface"):
        planner.line(above, down(0.75, 0, 0.221), LineLimits(0.04))


def test_an_obstacle_in_the_direct_way_is_avoided(arm: ArmKinematics) -> None:
    wall = collision.block("wall", collision.BASE, (0.45, -0.02, -0.3), (1.2, 0.02, 0.45))
    model = CollisionModel(arm, [*collision.arm_bodies(), *collision.tool_bodies(), wall])
    planner = Planner(arm, model)
    left, right = (planner.reach(down(0.7, y, 0.25), WORKING, "beside") for y in (0.35, -0.35))
    assert not all(model.free(q) for q in plan_joint(left, right, arm.limits).joints)
    motion = planner.free(left, right)
    assert all(model.free(q) for q in motion.joints)
    assert_within(motion, arm.limits)
    again = planner.free(left, right)
    assert np.array_equal(motion.joints, again.joints)


def test_a_slot_that_no_simple_detour_passes_is_searched(arm: ArmKinematics) -> None:
    solids = [
        collision.block("wall", collision.BASE, (0.45, -0.02, -0.3), (1.2, 0.02, 0.45)),
        collision.block("roof", collision.BASE, (0.45, -0.6, 0.75), (1.2, 0.6, 0.80)),
    ]
    model = CollisionModel(arm, [*collision.arm_bodies(), *collision.tool_bodies(), *solids])
    planner = Planner(arm, model)
    left, right = (planner.reach(down(0.6, y, 0.25), WORKING, "beside") for y in (0.30, -0.30))
    motion = planner.free(left, right)
    assert all(model.free(q) for q in motion.joints)


def test_without_ompl_ways_over_one_corner_are_tried_and_what_lacks_is_told(
    arm: ArmKinematics, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ompl", None)
    wall = collision.block("wall", collision.BASE, (0.45, -0.02, -0.3), (1.2, 0.02, 0.45))
    model = CollisionModel(arm, [*collision.arm_bodies(), *collision.tool_bodies(), wall])
    planner = Planner(arm, model)
    left, right = (planner.reach(down(0.7, y, 0.25), WORKING, "beside") for y in (0.35, -0.35))
    assert first_touch(model, np.stack([left, right])) is not None
    motion = planner.free(left, right)
    assert first_touch(model, motion.joints) is None
    assert np.array_equal(motion.joints, planner.free(left, right).joints)
    monkeypatch.setattr("cell.motion.planning.EFFORTS", EFFORTS[:1])
    monkeypatch.setattr(model, "free", lambda joints, allowed=(): not 0.0 < joints[0] - min(left[0], right[0]) < 1.0)
    with pytest.raises(CollisionError, match=r"over one corner.*ompl .*Python 3\.\d+"):
        planner.free(left, right)


def test_an_end_that_touches_is_refused_by_name(planner: Planner) -> None:
    deep = planner.kinematics.ik(down(0.75, 0.2, 0.10), WORKING)
    with pytest.raises(CollisionError, match="the end of the motion"):
        planner.free(WORKING, deep)


def test_bodies_need_names_and_sizes() -> None:
    with pytest.raises(ValueError, match="three lengths"):
        collision.box("flat", collision.BASE, pin.SE3.Identity(), (1.0, 0.0, 1.0))
    solid = collision.block("twin", collision.BASE, (0, 0, 0), (1, 1, 1))
    with pytest.raises(ValueError, match="names of their own"):
        CollisionModel(ArmKinematics(), [solid, solid])


def corners_on_the_flange() -> np.ndarray:
    """Corners of claw, scan head, target camera and part, homogeneous (n, 4), from their sizes as the cell has them."""
    found = [np.zeros(3)]
    for body in collision.tool_bodies((0.070, 0.036, 0.020), FLANGE_FROM_PART):
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        found += list(signs * np.array(body.size) / 2 @ body.placement.rotation.T + body.placement.translation)
    return np.column_stack([found, np.ones(len(found))])


def fastest_point(motion: Trajectory, count: int) -> float:
    """Speed in m/s of the fastest corner, by differences over `count` steps of plain matrices: not as planned."""
    times, table = np.linspace(0.0, motion.duration, count), DenavitHartenberg()
    flanges = np.eye(4)
    for column, d, a, alpha in zip(motion.joints.T, table.d, table.a, table.alpha, strict=True):
        q = np.interp(times, motion.times, column)
        (c, s), ca, sa, one = (np.cos(q), np.sin(q)), np.cos(alpha), np.sin(alpha), np.ones(count)
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        flanges = flanges @ np.array([[one * value for value in row] for row in rows]).transpose(2, 0, 1)
    placed = (corners_on_the_flange() @ flanges.transpose(0, 2, 1))[:, :, :3]
    return float(np.linalg.norm(np.diff(placed, axis=0), axis=2).max() / (times[1] - times[0]))


def test_no_point_of_flange_tool_or_part_is_faster_than_allowed_in_free_moves(arm: ArmKinematics) -> None:
    generator = np.random.default_rng(9)
    solids = collision.tool_bodies((0.070, 0.036, 0.020), FLANGE_FROM_PART)
    limits = JointLimits(speed=(1.6,) * 6, acceleration=(3.0,) * 6, jerk=(20.0,) * 6)
    bound = PointSpeed(arm, carried_points(solids), 0.5)
    unbound, speeds = [], []
    for _ in range(40):
        start = WORKING + generator.uniform(-1.0, 1.0, 6)
        end = WORKING + generator.uniform(-1.0, 1.0, 6)
        unbound.append(fastest_point(plan_joint(start, end, limits), 1000))
        motion = plan_joint(start, end, limits, points=bound)
        speeds.append(fastest_point(motion, 1000))
        assert np.allclose(motion.end, end)
    assert max(unbound) > 1.0, "the moves would be too fast otherwise"
    assert max(speeds) <= 0.5
    assert np.median(speeds) > 0.47, "and are not slower than need be"


def test_the_planners_moves_and_lines_keep_to_the_tool_speed(arm: ArmKinematics) -> None:
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


# --- between the samples ---


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


def link_frames(joints: Joints) -> list[np.ndarray]:
    """Base, the six frames that turn with a joint, and the flange, (4, 4), by plain matrices."""
    table, frames, pose = DenavitHartenberg(), [np.eye(4)], np.eye(4)
    for q, d, a, alpha in zip(joints, table.d, table.a, table.alpha, strict=True):
        c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        frames.append(pose @ [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        pose = pose @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return [*frames, pose]


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


def test_searched_ways_keep_five_millimetres_between_their_samples(planner: Planner, arm: ArmKinematics) -> None:
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


def test_a_fin_thinner_than_a_step_is_found_where_it_stands(arm: ArmKinematics) -> None:
    fin = collision.block("fin", collision.BASE, (0.3, -0.0005, 0.0), (1.2, 0.0005, 0.9))
    pole = collision.capsule("pole", collision.FLANGE, (0, 0, 0.01), (0, 0, 0.2), 0.01)
    model = CollisionModel(arm, [fin, pole])
    end = arm.ik(down(0.7, 0.15, 0.4), WORKING)
    start = end.copy()
    start[0] -= 0.5
    touch = first_touch(model, np.stack([start, end]))
    assert touch is not None
    assert touch.pairs == [("fin", "pole")]
    y = float(arm.fk(touch.joints).translation[1])
    assert abs(y) - 0.0105 == pytest.approx(0.005, abs=4e-4)
    assert first_touch(model, np.stack([start, end]), (("pole", "fin"),)) is None


def test_what_touches_at_the_beginning_may_open_but_not_close(arm: ArmKinematics) -> None:
    floor = collision.block("floor", collision.BASE, (0.3, -0.5, -0.1), (1.2, 0.5, 0.0))
    pole = collision.capsule("pole", collision.FLANGE, (0, 0, 0.0), (0, 0, 0.2), 0.01)
    model = CollisionModel(arm, [floor, pole])
    low, lower, high, away = (
        arm.ik(down(0.7, y, 0.21 + h), WORKING) for y, h in ((0, 1e-3), (0, 0), (0, 0.03), (0.1, 1e-3))
    )
    assert first_touch(model, np.stack([low, high])) is not None
    for way, free in (([low, high], True), ([low, lower], False), ([low, high, low], False), ([high, low], False)):
        touch = first_touch(model, np.array(way), opening=True)
        assert (touch is None) is free, way
    assert first_touch(model, plan_line(arm, low, arm.fk(away)).joints, opening=True) is None


HALF = np.pi / 2
URDF = {
    "UR3": (0.1519, -0.24365, -0.21325, 0.11235, -0.08535, 0.0819),
    "UR5": (0.089159, -0.425, -0.39225, 0.10915, -0.09465, 0.0823),
    "UR10": (0.1273, -0.612, -0.5723, 0.163941, -0.1157, 0.0922),
    "UR3e": (0.15185, -0.24355, -0.2132, 0.13105, -0.08535, 0.0921),
    "UR5e": (0.1625, -0.425, -0.3922, 0.1333, -0.0997, 0.0996),
    "UR10e": (0.1807, -0.6127, -0.57155, 0.17415, -0.11985, 0.11655),
    "UR16e": (0.1807, -0.4784, -0.36, 0.17415, -0.11985, 0.11655),
    "UR20": (0.2363, -0.862, -0.7287, 0.201, -0.1593, 0.1543),
    "UR30": (0.2363, -0.637, -0.5037, 0.201, -0.1593, 0.1543),
}
"""Of the vendor's `ur_description`, config/*/default_kinematics.yaml: shoulder z, forearm x, wrist 1 x and z, wrist 2
y, wrist 3 y, m. Its joints turn about frames of their own, not those of Denavit and Hartenberg."""

PUBLISHED = {
    "first": (
        "UR10e",
        [-0.000144894975118076141, 303.469135666158195, -309.88394307789747, 6.41459904397394975,
         -4.48232900190081995e-05, -0.00087071402790364627],
        [0.000108651068627930392, 0.240324175250532346, 0.00180628180213493472, 2.63076149165684402e-05,
         3.96638632500012715e-06, 0],
        [1.59613525316931737e-07, -0.917209621528830232, 7.12936131346499469, 0.0710299029424392298,
         -1.64258976526054923e-06, 9.17286101034808787e-08],
        [-0.000444781952841921679, -0.00160215112531214153, 0.00631917793331091861, -0.00165055247340828437,
         0.000763682515545038854, 0],
    ),
    "second": (
        "UR10e",
        [-0.000160188285741325043, 439.140974079900957, -446.027059806332147, 6.88618689642360149,
         -3.86588496858186748e-05, -0.00087908274257374186],
        [2.12234865571205891e-05, 0.632017132627700651, 0.00229833638891230319, -4.61409023720933908e-05,
         -6.39280053471801522e-05, 0],
        [-2.41478068943590252e-07, 1.60233952386694556, -1.68607190752171299, 0.0837331147700118711,
         -1.01260355871157781e-07, 3.91986209186123702e-08],
        [-0.000650246557584166496, 0.00139416666825590402, 0.00693818880325995126, -0.000811641562390219562,
         0.000411120504570705592, 0],
    ),
    "third": (
        "UR10",
        [0.00065609212979853, 1.4442162376284788, 0.854147723854608, -2.2989425877563705, -1.573498686836816e-05,
         1.9072435590711256e-05],
        [4.6311376834935676e-05, -0.00012568315331862312, 0.00186216581161458, 9.918593870679266e-05,
         4.215462720453189e-06, 0],
        [-7.290070070824746e-05, -0.01713897289704999, -0.03707159413492756, 0.054279462160583214,
         1.488984257025741e-07, 1.551499479707493e-05],
        [0.000211987863869334, -0.0072553625957652995, -0.013483226769541364, 0.0013495820227329425,
         -0.001263136163679901, 0],
    ),
}  # fmt: skip
"""Factory deltas of d, a, theta, alpha of three real arms, published in the tests of the maker's `ur_calibration`."""


def told(name: str) -> LinkTable:
    model, *deltas = PUBLISHED[name]
    drawn = MODELS[model].table
    d, a, theta, alpha = (
        tuple(np.add(base, delta).tolist())
        for base, delta in zip((drawn.d, drawn.a, (0.0,) * 6, drawn.alpha), deltas, strict=True)
    )
    return LinkTable(theta, a, d, alpha)


def by_hand(table: LinkTable, joints: np.ndarray) -> np.ndarray:
    """The product of the four elementary transformations of each joint, nothing else."""
    pose = np.eye(4)
    for q, theta, a, d, alpha in zip(joints, table.theta, table.a, table.d, table.alpha, strict=True):
        c, s, ca, sa = np.cos(q + theta), np.sin(q + theta), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return pose


def of_urdf(name: str, joints: np.ndarray) -> pin.SE3:
    """base_link_inertia to flange (wrist 3) of the vendor's description."""
    z, forearm, x, across, down, out = URDF[name]
    offsets = (
        ((0, 0, z), (0, 0, 0)), ((0, 0, 0), (HALF, 0, 0)), ((forearm, 0, 0), (0, 0, 0)),
        ((x, 0, across), (0, 0, 0)), ((0, down, 0), (HALF, 0, 0)), ((0, out, 0), (HALF, np.pi, np.pi)),
    )  # fmt: skip
    pose = pin.SE3.Identity()
    for (shift, turn), angle in zip(offsets, joints, strict=True):
        pose = pose * pin.SE3(pin.rpy.rpyToMatrix(*turn), np.array(shift, dtype=float))
        pose = pose * pin.SE3(pin.utils.rotate("z", angle), np.zeros(3))
    return pose


@pytest.mark.parametrize("name", list(URDF))
def test_each_model_as_drawn_is_that_of_the_vendors_description(name: str) -> None:
    arm, simulated = arm_kinematics(name, None), Kinematics(TABLES[name])
    for joints in np.random.default_rng(3).uniform(-3.0, 3.0, (20, 6)):
        expected = of_urdf(name, joints).homogeneous
        np.testing.assert_allclose(arm.fk(joints).homogeneous, expected, atol=1e-9)
        np.testing.assert_allclose(simulated.forward(joints), expected, atol=1e-9)


def test_the_cell_and_the_world_know_the_same_models() -> None:
    assert set(MODELS) == set(TABLES) == set(URDF) | {"UR7e", "UR12e"}


@pytest.mark.parametrize("name", list(PUBLISHED))
def test_a_factory_table_is_kept_exactly_and_its_poses_are_reached(name: str) -> None:
    table = told(name)
    arm = arm_kinematics(PUBLISHED[name][0], table)
    rng = np.random.default_rng(5)
    for joints in rng.uniform(-2.5, 2.5, (25, 6)):
        expected = by_hand(table, joints)
        np.testing.assert_allclose(arm.fk(joints).homogeneous, expected, atol=2e-9)
        found = arm.solutions(pin.SE3(expected), joints + rng.uniform(-0.2, 0.2, 6))
        assert any(np.allclose(answer, joints, atol=1e-6) for answer in found)
        for answer in found:
            np.testing.assert_allclose(by_hand(table, answer), expected, atol=1e-6)


@pytest.mark.parametrize("name", list(PUBLISHED))
def test_the_bodies_of_a_calibrated_arm_are_where_the_drawing_has_them_to_a_centimetre(name: str) -> None:
    model = PUBLISHED[name][0]
    drawn, calibrated = arm_kinematics(model, None), arm_kinematics(model, told(name))
    bodies = arm_bodies(model)
    for joints in np.random.default_rng(6).uniform(-2.5, 2.5, (20, 6)):
        places = []
        for arm in (drawn, calibrated):
            data = arm.model.createData()
            pin.forwardKinematics(arm.model, data, joints)
            places.append([data.oMi[body.parent] * body.placement for body in bodies])
        for first, second in zip(*places, strict=True):
            assert np.linalg.norm(first.translation - second.translation) < 0.01
    assert CollisionModel(calibrated, bodies).touching(np.radians([0, -90, 90, -90, -90, 0])) == []


@pytest.mark.parametrize("name", ["UR3e", "UR5e", "UR20"])
def test_an_arm_of_another_model_is_named(name: str) -> None:
    drawn = MODELS[name].table
    with pytest.raises(ConfigError, match=rf"The nearest model is {name} \(0.0 mm\): correct arm.model"):
        arm_kinematics("UR10e", LinkTable(drawn.theta, drawn.a, drawn.d, drawn.alpha))


def test_a_calibration_is_named_after_the_table_to_the_last_bit() -> None:
    table = told("first")
    other = LinkTable(table.theta, table.a, table.d, (*table.alpha[:5], 1e-15))
    names = {kinematics_name("UR10e", t) for t in (None, table, other, told("second"))}
    assert len(names) == 4
    assert kinematics_name("UR10e", told("first")) == kinematics_name("UR10e", table)


def test_kinematics_info_is_read_byte_by_byte() -> None:
    numbers = [float(k) / 8 for k in range(24)]
    data = struct.pack(">6I", *range(1, 7)) + struct.pack(">24d", *numbers) + struct.pack(">I", 2)
    assert parse_kinematics_info(data + b"more") == LinkTable(*(tuple(numbers[k : k + 6]) for k in (0, 6, 12, 18)))
