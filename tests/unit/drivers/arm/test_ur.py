"""The arm driver against a simulated arm over the real protocols, through everything that can go wrong."""

import numpy as np
import pytest

from drivers.errors import InterlockError, LimitError
from tests.support.wire.arm_bench import joints_away, swing

pytestmark = pytest.mark.wire


def test_it_knows_who_the_arm_is_and_how_long_a_round_trip_takes(arm, bench):
    identity = arm.identity()
    assert (identity.model, identity.serial, identity.firmware) == ("UR10e", "20235500001", "5.15.2.1130077")
    assert identity.address == bench.address
    assert 0.0 < arm.ping() < 1.0
    assert len(arm.statistics.round_trips_s) == 1


def test_it_sets_a_zero_tool_and_the_payload_and_keeps_them_through_a_recovery(arm, bench):
    shown = bench.ask("show")
    assert np.array_equal(shown["tcp"], np.eye(4))
    assert shown["payload"] == 1.5
    arm.set_payload(2.5, np.array([0.0, 0.0, 0.1]))
    assert bench.ask("show")["payload"] == 2.5
    arm.recover()
    assert bench.ask("show")["payload"] == 2.5


def test_nothing_is_sent_when_limits_or_interlocks_forbid_it(arm, bench):
    stands = bench.ask("show")["q"]
    with pytest.raises(LimitError, match="angle of joint 1"):
        arm.move_joints(joints_away(arm, 9.0), 1.0, 2.0)
    with pytest.raises(LimitError, match="speed of joint 1"):
        arm.move_joints(joints_away(arm, 0.5), 3.0, 2.0)
    with pytest.raises(LimitError, match="flange speed 1500 mm/s"):
        arm.move_linear(arm.state().flange, 1.5, 1.0)
    times, joints = swing(arm, 0.2, 1.0)
    with pytest.raises(InterlockError, match="away from where joint 2 stands"):
        arm.follow(times, joints + np.array([0, 0.05, 0, 0, 0, 0]))
    with pytest.raises(LimitError, match="output 18 does not exist"):
        arm.set_digital_output(18, True)
    assert bench.ask("show")["q"] == stands
