"""Promises of `drivers.arm.child.control`."""

import threading
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.arm.ur import UrArm
from drivers.clock import Clock
from drivers.errors import Aborted, DeviceFault
from drivers.interfaces import ArmSafety
from tests.support.wire.arm_bench import joints_away, soon

pytestmark = pytest.mark.wire


def test_a_straight_move_reaches_its_target(arm):
    target = arm.state().flange + np.array([0, 0.05, 0.02, 0, 0, 0])
    arm.move_linear(target, 0.2, 1.0).wait(5.0)
    flange = arm.state().flange
    assert np.abs(flange[:3] - target[:3]).max() < 1e-6
    turned = Rotation.from_rotvec(flange[3:]).inv() * Rotation.from_rotvec(target[3:])
    assert turned.magnitude() < 1e-6
    arm.move_linear(target - np.array([0, 0.05, 0.02, 0, 0, 0]), 0.2, 1.0).wait(5.0)


def test_a_stop_from_another_thread_overtakes_a_straight_move(arm):
    moving = arm.move_linear(arm.state().flange + np.array([0, 0.2, 0, 0, 0, 0]), 0.05, 1.0)
    assert soon(lambda: arm.state().moving)
    stopper, begun = threading.Thread(target=arm.stop), time.monotonic()
    stopper.start()
    with pytest.raises(Aborted):
        moving.wait(10.0)
    stopper.join(5.0)
    assert time.monotonic() - begun < 1.0 and not arm.state().moving


def test_an_emergency_stop_is_a_fault_that_only_the_operator_can_clear(bench):
    arm = UrArm("arm", bench.address, clock=Clock())
    moving = arm.move_joints(joints_away(arm, 1.5), 0.5, 2.0)
    assert soon(lambda: arm.state().moving)
    bench.ask("emergency_stop")
    with pytest.raises(DeviceFault) as caught:
        moving.wait(5.0)
    assert (caught.value.code, caught.value.recoverable) == ("arm.emergency_stop", False)
    with pytest.raises(DeviceFault, match="emergency stop is pressed"):
        arm.recover()
    assert arm.state().safety is ArmSafety.EMERGENCY_STOP
    arm.close()
    # With the button still pressed the driver connects, shows the state and refuses to move.
    again = UrArm("arm", bench.address, clock=Clock())
    assert again.state().safety is ArmSafety.EMERGENCY_STOP
    with pytest.raises(DeviceFault, match="emergency stop is pressed"):
        again.move_joints(again.state().joints, 1.0, 1.0)
    again.close()
