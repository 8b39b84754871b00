"""What the arm driver refuses before anything is sent, and the small pieces under it."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from drivers.arm.dashboard import Dashboard
from drivers.arm.factory import flange_agrees, require_same_flange, same_payload
from drivers.arm.faults import unlock
from drivers.arm.feed import Snapshot, StateFeed
from drivers.arm.motion import ArmLimits, UrMotion
from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceFault, LimitError, NotConnectedError
from drivers.interfaces import LinkStatistics

LIMITS = ArmLimits()
REST = np.array([0.0, -1.5, -1.5, -1.5, 1.5, 0.0])


def test_angles_inside_the_limits_pass_and_others_are_named_with_value_range_and_unit():
    assert LIMITS.check_joints("arm", REST) is not None
    with pytest.raises(LimitError, match=r"angle of joint 3 400 deg is outside -360 deg to 360 deg"):
        LIMITS.check_joints("arm", np.radians([0, 0, 400, 0, 0, 0]))


@pytest.mark.parametrize("joints", [np.zeros(5), np.full(6, np.nan), np.zeros((2, 6))])
def test_anything_but_six_finite_angles_is_refused(joints):
    with pytest.raises(LimitError, match="6 finite numbers"):
        LIMITS.check_joints("arm", joints)


@pytest.mark.parametrize("axis", range(3))
def test_a_pose_out_of_reach_is_refused(axis):
    flange = np.zeros(6)
    flange[axis] = -2.0
    with pytest.raises(LimitError, match=r"distance of the flange from the base 2000 mm is outside 0 mm to 1450 mm"):
        LIMITS.check_pose("arm", flange)


@pytest.mark.parametrize(
    ("speed", "acceleration", "message"),
    [
        (0.0, 1.0, "joint speed 0 deg/s"),
        (-1.0, 1.0, "joint speed"),
        (4.0, 1.0, "to 180 deg/s"),
        (1.0, 9.0, "acceleration"),
    ],
)
def test_speeds_and_accelerations_have_limits(speed, acceleration, message):
    with pytest.raises(LimitError, match=message):
        LIMITS.check_joint_move("arm", speed, acceleration)


@pytest.mark.parametrize(
    ("speed", "acceleration", "message"),
    [
        (0.0, 1.0, "flange speed 0 mm/s"),
        (1.1, 1.0, "to 1000 mm/s"),
        (0.1, 5.1, "flange acceleration 5100 mm"),
        (0.1, -1.0, "flange acc"),
    ],
)
def test_straight_moves_have_limits_of_their_own(speed, acceleration, message):
    LIMITS.check_linear_move("arm", 1.0, 5.0)
    with pytest.raises(LimitError, match=message):
        LIMITS.check_linear_move("arm", speed, acceleration)


def test_a_payload_too_heavy_is_refused():
    with pytest.raises(LimitError, match=r"payload 13 kg is outside 0 kg to 12\.5 kg"):
        LIMITS.check_payload("arm", 13.0, np.zeros(3))


@pytest.mark.parametrize("axis", range(3))
def test_a_centre_of_gravity_in_millimetres_is_refused(axis):
    with pytest.raises(LimitError, match="payload offset"):
        LIMITS.check_payload("arm", 1.0, np.eye(3)[axis] * -60.0)


@pytest.mark.parametrize(
    ("times", "joints", "message"),
    [
        ([0.0], [REST], "at least 2"),
        ([0.0, 1.0], [REST[:5], REST[:5]], "at least 2"),
        ([0.1, 1.0], [REST, REST], "begin at 0 s"),
        ([0.0, 1.0, 1.0], [REST, REST, REST], "increase"),
        ([0.0, np.inf], [REST, REST], "not finite"),
        ([0.0, 1.0], [REST, np.where(np.arange(6) == 2, np.nan, REST)], "not finite"),
        ([0.0, 9.0, 8.0], [REST, REST, REST], "increase"),
        ([0.0, 1.0], [REST, REST + 8], "angle of joint 1 on the trajectory"),
        ([0.0, 9.0], [REST, REST - 6.5], "angle of joint 1 on the trajectory"),
        (
            [0.0, 0.01],
            [REST, REST + np.array([0, 0.1, 0, 0, 0, 0])],
            r"joint 2 would turn at 572\.958 deg/s at 0\.000 s",
        ),
        # Joint 6 turns faster, and may.
        ([0.0, 1.0], [REST, REST + np.array([0, -2.2, 0, 0, 0, 3.0])], r"joint 2 would turn at 126\.051 deg/s"),
    ],
)
def test_a_trajectory_that_cannot_be_driven_is_refused(times, joints, message):
    with pytest.raises(LimitError, match=message):
        LIMITS.check_trajectory("arm", np.array(times), np.array(joints))


def motion(stops):
    return UrMotion("arm", "move", 1, Clock(), lambda: stops.append("stop"))


def test_a_motion_that_arrived_can_be_waited_for_twice():
    moving = motion([])
    assert not moving.done
    moving.end("arrived")
    moving.wait(0.0)
    moving.wait(0.0)
    assert moving.done
    assert not moving.contact


def test_a_motion_that_ended_at_its_force_limit_says_so_without_an_error():
    moving = motion([])
    moving.end("contact")
    moving.wait(0.0)
    assert moving.contact


def test_a_motion_that_takes_too_long_is_stopped():
    stops = []
    with pytest.raises(DeadlineError, match=r"did not end within 0\.01 s and was stopped"):
        motion(stops).wait(0.01)
    assert stops == ["stop"]


def test_a_stopped_or_failed_motion_never_returns():
    stopped, failed = motion([]), motion([])
    stopped.end("stopped")
    failed.end("arm.protective_stop")
    failed.end("arrived")
    with pytest.raises(Aborted):
        stopped.wait(1.0)
    with pytest.raises(DeviceFault) as caught:
        failed.wait(1.0)
    assert caught.value.code == "arm.protective_stop"


@pytest.fixture
def server():
    """A dashboard server on a free loopback address whose behaviour a test sets."""
    for number in itertools.count(200):
        listener = socket.socket()
        try:
            listener.bind((f"127.0.0.{number}", 29999))
            break
        except OSError:
            listener.close()
    listener.listen()
    yield listener
    listener.close()


def test_the_dashboard_answers_line_by_line_over_one_connection(server):
    def serve():
        client, _ = server.accept()
        with client:
            client.sendall(b"Connected\n")
            for question in client.makefile("rb"):
                client.sendall(b"you said " + question)

    threading.Thread(target=serve, daemon=True).start()
    dashboard = Dashboard("arm", server.getsockname()[0])
    assert dashboard.ask("robotmode") == "you said robotmode"
    assert dashboard.ask("stop") == "you said stop"
    dashboard.close()


def test_a_silent_dashboard_is_a_deadline_and_a_missing_one_is_not_connected(server):
    dashboard = Dashboard("arm", server.getsockname()[0], timeout=0.05)
    with pytest.raises(DeadlineError, match=r"did not answer 'stop' within 0\.05 s"):
        dashboard.ask("stop")
    with pytest.raises(NotConnectedError, match=r"127\.255\.0\.9:29999 is not reachable"):
        Dashboard("arm", "127.255.0.9").ask("stop")


def feed(clock):
    return StateFeed("arm", clock, lambda: False, lambda: None, LinkStatistics())


def snapshot(stamp, **shown):
    still = (0.0,) * 6
    return Snapshot(
        stamp,
        still,
        still,
        still,
        still,
        **{"safety_bits": 1, "mode": 7, "runtime": 2, "inputs": 0, "outputs": 0} | shown,
    )


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


@pytest.mark.parametrize(
    ("off", "agrees"),
    [
        ((0.04e-3, 0, 0, 0, 0, 0), True),
        ((0, -0.06e-3, 0, 0, 0, 0), False),
        ((0, 0, 0, 0.09e-3, 0, 0), True),
        ((0, 0, 0, 0, 0, -0.11e-3), False),
    ],
)
def test_another_arm_is_told_by_its_flange_in_place_and_in_turn(off, agrees):
    seen = replace(snapshot(0.0), flange=off)
    assert flange_agrees(lambda joints: np.zeros(6), seen) is agrees
    if agrees:
        require_same_flange("arm", lambda joints: np.zeros(6), seen)
        return
    with pytest.raises(DeviceFault, match="nothing was moved") as caught:
        require_same_flange("arm", lambda joints: np.zeros(6), seen)
    assert not caught.value.recoverable


@pytest.mark.parametrize(
    ("mass", "centre", "same"),
    [
        (2.0, (0.0, 0.0, 0.05), True),
        (2.01, (0.0, 0.0, 0.05), False),
        (1.99, (0.0, 0.0, 0.05), False),
        (2.0, (0.0, 0.001, 0.05), False),
        (2.0, (0.0, 0.0, -0.05), False),
    ],
)
def test_another_payload_is_told_by_its_mass_and_by_its_centre(mass, centre, same):
    seen = replace(snapshot(0.0), payload=(mass, centre))
    assert same_payload(seen, (2.0, (0.0, 0.0, 0.05))) is same
    assert same_payload(seen, (mass, (0.0, 0.0, 0.0)))  # a centre of zeros is none


def dashboard_of(server, status):
    """A connected dashboard, and what it asks; `status` answers a question, None: that it is not understood."""
    asked = []

    def serve():
        client, _ = server.accept()
        with client:
            client.sendall(b"Connected\n")
            for question in client.makefile("rb"):
                asked.append(question.decode().strip())
                told = status(asked[-1])
                reply = f"could not understand: '{asked[-1]}'" if told is None else f"Safetystatus: {told}"
                client.sendall(f"{reply}\n".encode())

    threading.Thread(target=serve, daemon=True).start()
    return Dashboard("arm", server.getsockname()[0]), asked


@pytest.mark.parametrize("known", ["safetystatus", "safetymode"])
@pytest.mark.parametrize(
    ("status", "why"),
    [
        ("REDUCED", ""),
        ("PROTECTIVE_STOP", "a person confirms"),
        ("RECOVERY", "outside its safety limits"),
        ("SYSTEM_THREE_POSITION_ENABLING_STOP", "the safeguard is open"),
        ("VIOLATION", "reports a fault"),
    ],
)
def test_reduced_mode_is_no_fault_and_a_protective_stop_needs_a_person(server, status, why, known):
    """Before PolyScope 5.4 a controller knows only the safety mode."""
    dashboard, asked = dashboard_of(server, lambda question: status if question == known else None)
    if not why:
        unlock("arm", dashboard, Clock(), False, lambda: None)
    else:
        with pytest.raises(DeviceFault, match=why):
            unlock("arm", dashboard, Clock(), False, lambda: None)
    assert asked == ["safetystatus", "safetymode"][: 1 if known == "safetystatus" else 2]
    dashboard.close()


def test_a_stop_that_comes_before_a_protective_stop_is_unlocked_leaves_it_locked(server):
    def stopped():
        raise Aborted("stopped meanwhile")

    dashboard, asked = dashboard_of(server, lambda question: "PROTECTIVE_STOP")
    with pytest.raises(Aborted, match="meanwhile"):
        unlock("arm", dashboard, Clock(), True, stopped)
    dashboard.close()
    assert asked == ["safetystatus"]


def test_the_age_of_a_state_is_in_seconds_of_the_clock():
    assert feed(Clock(20.0)).age(snapshot(time.monotonic() - 0.1)) == pytest.approx(2.0, abs=1.0)
    assert feed(Clock()).age(snapshot(time.monotonic() - 0.1)) == pytest.approx(0.1, abs=0.05)


def test_a_clock_that_runs_faster_leaves_the_wire_its_time():
    moving = UrMotion("arm", "move", 1, Clock(rate=100.0), lambda: None)
    threading.Timer(0.1, lambda: moving.end("arrived")).start()
    moving.wait(1.0)
