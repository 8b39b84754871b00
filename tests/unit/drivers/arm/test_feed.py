"""Promises of `drivers.arm.feed`."""

import threading
import time
from dataclasses import replace

import pytest

from drivers.arm.feed import StateFeed, safety_code
from drivers.arm.motion import UrMotion
from drivers.clock import Clock
from drivers.errors import DeadlineError
from drivers.interfaces import LinkStatistics
from tests.support.wire.arm_bench import snapshot

SAFETY_BITS = {
    "arm.protective_stop": [2], "arm.recovery_mode": [3], "arm.safeguard_stop": [4, 10],
    "arm.emergency_stop": [5, 6, 7], "arm.safety_fault": [8, 9],
}  # fmt: skip
"""docs/reference/protocols.md, section 1."""


@pytest.mark.parametrize("code", SAFETY_BITS)
def test_safety_bits_have_the_makers_meaning_and_an_emergency_stop_outranks_a_protective_stop(code):
    assert {safety_code(1 << bit) for bit in SAFETY_BITS[code]} == {code}
    assert (safety_code(1), safety_code(1 << 2 | 1 << 6)) == ("", "arm.emergency_stop")


def feed(clock):
    return StateFeed("arm", clock, lambda: False, lambda: None, LinkStatistics())


@pytest.mark.parametrize("rate", [1.0, 20.0])
def test_an_old_state_never_passes_as_fresh(rate):
    states = feed(Clock(rate))
    states.take(snapshot(time.monotonic() - 0.2, outputs=1))
    with pytest.raises(DeadlineError, match="at most 100 ms old"):
        states.fresh(0.1)


def test_a_state_that_is_young_enough_is_taken_and_one_that_comes_meanwhile_is_waited_for():
    states = feed(Clock())
    states.take(snapshot(time.monotonic() - 0.2, outputs=1))
    found, age = states.fresh(2.0)
    assert found.outputs == 1
    assert 0.2 <= age < 1.0
    threading.Timer(0.05, lambda: states.take(snapshot(time.monotonic(), outputs=2))).start()
    found, age = states.fresh(0.1)
    assert found.outputs == 2
    assert age < 0.1


def test_a_state_from_before_the_call_does_not_do_when_none_older_than_the_call_is_wanted():
    states = feed(Clock())
    states.take(snapshot(time.monotonic()))
    threading.Timer(0.05, lambda: states.take(snapshot(time.monotonic(), outputs=2))).start()
    assert states.fresh(0.0)[0].outputs == 2


def test_a_program_that_is_paused_does_not_run():
    assert [snapshot(0.0, runtime=runtime).program_running for runtime in range(6)] == [False] * 2 + [True] + [
        False
    ] * 3


def test_an_arm_that_turns_any_joint_either_way_is_not_at_rest():
    assert replace(snapshot(0.0), speeds=(0.002, -0.002) * 3).at_rest
    for joint in range(6):
        for speed in (0.01, -0.01):
            assert not replace(snapshot(0.0), speeds=tuple(speed * (k == joint) for k in range(6))).at_rest


def test_what_was_seen_before_a_new_link_is_forgotten():
    states = feed(Clock())
    states.take(snapshot(time.monotonic()))
    states.forget()
    assert not states.wait_for(lambda seen: True, 0.01)


def test_the_age_of_a_state_is_in_seconds_of_the_clock():
    assert feed(Clock(20.0)).age(snapshot(time.monotonic() - 0.1)) == pytest.approx(2.0, abs=1.0)
    assert feed(Clock()).age(snapshot(time.monotonic() - 0.1)) == pytest.approx(0.1, abs=0.05)


def test_a_clock_that_runs_faster_leaves_the_wire_its_time():
    moving = UrMotion("arm", "move", 1, Clock(rate=100.0), lambda: None)
    threading.Timer(0.1, lambda: moving.end("arrived")).start()
    moving.wait(1.0)
