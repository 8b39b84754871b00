"""Promises of `drivers.arm.child.streaming`."""

import signal
import time

import numpy as np
import pytest

from drivers.arm.ur import UrArm
from drivers.clock import Clock
from drivers.interfaces import ArmSafety
from tests.support.wire.arm_bench import ArmBench, joints_away, swing

pytestmark = pytest.mark.wire


def lowering(arm, depth, seconds):
    """Times and joints of a straight descent, with the joints that the arm itself reports along such a move."""
    top = arm.state()
    goal = top.flange - np.array([0, 0, depth, 0, 0, 0])
    with arm.record() as states:
        arm.move_linear(goal, 0.1, 1.0).wait(10.0)
    joints, heights = [top.joints], [top.flange[2]]
    for state in states:
        if state.flange[2] < heights[-1] - 1e-4:
            joints.append(state.joints)
            heights.append(state.flange[2])
    arm.move_joints(top.joints, 1.0, 2.0).wait(10.0)
    times = (heights[0] - np.array(heights)) / depth * seconds
    return times, np.array(joints)


def descent_to_the_table(arm):
    """Times and joints of a straight descent at 30 mm/s: from 15 mm above the table of 20 N/mm to 10 mm into it."""
    above = arm.state().flange
    above[2] = 0.515
    arm.move_linear(above, 0.5, 2.0).wait(5.0)
    arm.zero_force()
    times, joints = lowering(arm, 0.014, 14 / 30)
    slope = (joints[-1] - joints[-4]) / (times[-1] - times[-4])
    seconds = 11 / 30
    return np.append(times, times[-1] + seconds), np.vstack([joints, joints[-1] + seconds * slope])


def test_a_guarded_descent_ends_at_rest_on_the_table(arm):
    times, joints = descent_to_the_table(arm)
    top = arm.state().flange
    moving = arm.follow(times, joints, force_limit=15.0)
    moving.wait(5.0)
    assert moving.contact
    state = arm.state()
    assert not state.moving
    assert 0.497 < state.flange[2] < 0.5
    assert state.safety is ArmSafety.NORMAL
    arm.move_linear(top, 0.2, 1.0).wait(5.0)


def test_a_guarded_descent_waits_for_an_arm_that_reports_late(arm, bench):
    """Held up for 80 ms again and again, the arm goes at most as far as in 40 ms deeper than otherwise."""
    depths = []
    for held_up in (0.0, 0.08):
        times, joints = descent_to_the_table(arm)
        top = arm.state().flange
        moving = arm.follow(times, joints, force_limit=15.0)
        clock = Clock()
        while not moving.done and clock.now() < 30.0:
            if held_up:
                bench.process.send_signal(signal.SIGSTOP)
                Clock().sleep(held_up)
                bench.process.send_signal(signal.SIGCONT)
            Clock().sleep(0.03)
        moving.wait(10.0)
        assert moving.contact
        depths.append(0.5 - arm.state().flange[2])
        arm.move_linear(top, 0.2, 1.0).wait(5.0)
    assert depths[1] - depths[0] < 0.03 * 0.04


def test_a_descent_that_meets_nothing_arrives_without_contact(arm):
    times, joints = swing(arm, -0.2, 0.4)
    moving = arm.follow(times, joints, force_limit=15.0)
    moving.wait(5.0)
    assert not moving.contact


def test_a_world_ten_times_as_fast_is_driven_with_a_clock_ten_times_as_fast():
    with ArmBench(speed=10.0) as bench:
        arm = UrArm("arm", bench.address, clock=Clock(rate=10.0))
        target = joints_away(arm, 0.5)
        arm.move_joints(target, 0.5, 2.0).wait(5.0)
        assert np.abs(arm.state().joints - target).max() < 1e-6
        times, joints = swing(arm, -0.5, 3.0)
        begun = time.monotonic()
        arm.follow(times, joints).wait(10.0)
        assert time.monotonic() - begun < 1.5, "three seconds of the cell take a third of one on the wall"
        assert np.abs(arm.state().joints - joints[-1]).max() < 2e-3
        arm.close()
