"""Bodies that touch are named, between two looks at a way as well; those that may are left out."""

import numpy as np
import pinocchio as pin
import pytest

from cell.motion import collision
from cell.motion.collision import CollisionError, CollisionModel, arm_bodies, first_touch
from cell.motion.kinematics import ArmKinematics, arm_kinematics
from cell.motion.planning import Planner
from cell.motion.trajectory import plan_line
from tests.unit.cell.motion.conftest import RESTING, WORKING, down
from tests.unit.cell.motion.test_kinematics import PUBLISHED, told


def test_a_posture_in_the_table_names_what_touches(planner: Planner):
    with pytest.raises(CollisionError, match=r"deep: .*table"):
        planner.reach(down(0.75, 0.2, 0.10), WORKING, "deep")


def test_the_part_may_touch_the_surface_only_where_allowed(planner: Planner):
    resting = planner.kinematics.ik(down(0.75, 0.0, 0.222), WORKING)
    assert ("part", "surface") in planner.collisions.touching(resting)
    assert planner.collisions.touching(resting, RESTING) == []


def test_bodies_need_names_and_sizes():
    with pytest.raises(ValueError, match="three lengths"):
        collision.box("flat", collision.BASE, pin.SE3.Identity(), (1.0, 0.0, 1.0))
    solid = collision.block("twin", collision.BASE, (0, 0, 0), (1, 1, 1))
    with pytest.raises(ValueError, match="names of their own"):
        CollisionModel(ArmKinematics(), [solid, solid])


def test_a_fin_thinner_than_a_step_is_found_where_it_stands(arm: ArmKinematics):
    fin = collision.block("fin", collision.BASE, (0.3, -0.0005, 0.0), (1.2, 0.0005, 0.9))
    pole = collision.capsule("pole", collision.FLANGE, (0, 0, 0.01), (0, 0, 0.2), 0.01)
    model = CollisionModel(arm, [fin, pole])
    end = arm.ik(down(0.7, 0.15, 0.4), WORKING)
    start = end.copy()
    start[0] -= 0.5
    touch = first_touch(model, np.stack([start, end]))
    assert touch.pairs == [("fin", "pole")]
    y = float(arm.fk(touch.joints).translation[1])
    assert abs(y) - 0.0105 == pytest.approx(0.005, abs=4e-4)
    assert first_touch(model, np.stack([start, end]), (("pole", "fin"),)) is None


def test_what_touches_at_the_beginning_may_open_but_not_close(arm: ArmKinematics):
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


@pytest.mark.parametrize("name", list(PUBLISHED))
def test_the_bodies_of_a_calibrated_arm_are_where_the_drawing_has_them_to_a_centimetre(name: str):
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
