"""How the arm's motions end: by a stop, a pulled cable, a recovery that is stopped; and what is not the driver's."""

import itertools
import os
import re
import signal
import socket
import threading
import time
from contextlib import suppress

import numpy as np
import pinocchio as pin
import pytest

from cell.devices.devices import Devices, require_healthy
from cell.devices.gate.gate import Gate
from cell.devices.gate.interlocks import Interlocks
from cell.measure.geometry.poses import to_ur
from drivers.arm.ur import UrArm
from drivers.clock import Clock
from drivers.errors import Aborted, CellError, DeviceFault, InterlockError, NotConnectedError
from drivers.interfaces import ArmSafety
from lab.bench.wires.soak import descendants
from tests.support import running as running_process
from tests.support.simulator.ur_client import flange
from tests.support.wire.arm_bench import HOME, ArmBench, dashboard, soon
from tests.support.wire.cable import Cable
from tests.support.wire.shared_arm import shared_arm

pytestmark = pytest.mark.wire

LASER = 0
SAFE_STOP_S = 5.0
"""What a cell's safe stop has for everything."""


def connect(address, **options):
    return UrArm("arm", address, safe_off_outputs=(LASER,), clock=Clock(), **options)


running, shared, bench, arm = shared_arm(connect)


@pytest.fixture
def closes(shared):
    """For a test that closes the driver."""
    yield
    shared.close()


def swinging(arm, bench, kind="joints", speed=0.5):
    """A long turn of the first joint that is under way."""
    start = arm.state().joints
    goal = start + np.array([2.0, 0, 0, 0, 0, 0])
    if kind == "joints":
        motion = arm.move_joints(goal, speed, 2.0)
    else:
        times = np.linspace(0.0, 2.0 * np.pi / speed / 2, 400)
        part = 0.5 * (1.0 - np.cos(np.pi * times / times[-1]))
        motion = arm.follow(times, start + part[:, None] * (goal - start))
    assert soon(lambda: bench.ask("show")["q"][0] > start[0] + 0.05)
    return motion


def stands_still(bench, seconds=0.3):
    """Whether the arm itself knows of no motion for that long."""
    before = np.array(bench.ask("show")["q"])
    clock = Clock()
    while clock.now() < seconds:
        shown = bench.ask("show")
        if shown["moving"] or np.abs(np.array(shown["q"]) - before).max() > 1e-6:
            return False
        clock.sleep(0.01)
    return True


def children():
    """Processes that this one has started and that have not ended."""
    return set(filter(running_process, descendants(os.getpid())))


# --- paused programs ---


@pytest.mark.parametrize(
    ("kind", "state"),
    [*itertools.product(["joints"], ["playing", "pausing", "paused", "resuming"]),
     ("follow", "playing"), pytest.param("follow", "paused", marks=pytest.mark.campaign)],
)  # fmt: skip
def test_after_a_stop_nothing_goes_on_whatever_the_program_was_doing(arm, bench, kind, state):
    moving = swinging(arm, bench, kind)
    if state != "playing":
        assert dashboard(bench.address, "pause") == ["Pausing program"]
    if state in ("paused", "resuming"):
        assert soon(lambda: not bench.ask("show")["moving"])
    if state == "resuming":
        dashboard(bench.address, "play")
    arm.stop()
    assert not bench.ask("show")["moving"], "the arm stands when the stop returns"
    dashboard(bench.address, "play")
    assert stands_still(bench)
    with pytest.raises((Aborted, DeviceFault)):
        moving.wait(5.0)
    arm.recover()
    target = arm.state().joints - np.array([0.05, 0, 0, 0, 0, 0])
    arm.move_joints(target, 1.0, 2.0).wait(5.0)
    assert np.abs(np.array(bench.ask("show")["q"]) - target).max() < 1e-6


@pytest.mark.parametrize(
    ("held", "stopped"), [("safeguard_stop", True), ("safeguard_stop", False), ("protective_stop", False)]
)
def test_an_arm_that_was_held_does_not_go_on_when_it_is_let_go_by_hand(arm, bench, held, stopped):
    moving = swinging(arm, bench)
    bench.ask(held)
    if stopped:
        arm.stop()
    with pytest.raises((Aborted, DeviceFault), match="protective stop" if held == "protective_stop" else None):
        moving.wait(5.0)
    assert soon(lambda: not bench.ask("show")["moving"])
    bench.ask("clear")
    dashboard(bench.address, "play")
    assert stands_still(bench)
    arm.recover()
    arm.move_joints(HOME, 1.0, 2.0).wait(5.0)


# --- a lost link ---


def test_a_call_that_races_with_the_loss_of_its_link_ends_at_once(arm):
    """The link is lost after the call has begun and before it is waited for."""
    link = arm._session.link
    inner = link._lock

    class LostMeanwhile:
        def __enter__(self):
            link._lock = inner
            link._fail("it was cut in the test")
            return inner.__enter__()

        def __exit__(self, *error):
            return inner.__exit__(*error)

    link._lock = LostMeanwhile()
    begun = time.monotonic()
    with pytest.raises(DeviceFault, match="it was cut in the test"):
        link.call("stop", deadline=3.0)
    assert time.monotonic() - begun < 0.5


def test_a_stop_without_the_link_stops_the_arm_by_the_other_way_and_says_nothing_else(arm, bench):
    arm.set_digital_output(LASER, True)
    swinging(arm, bench)
    os.kill(arm._session.link.pid, signal.SIGKILL)
    begun = time.monotonic()
    arm.stop()
    assert time.monotonic() - begun < SAFE_STOP_S
    shown = bench.ask("show")
    assert not shown["moving"]
    assert not shown["outputs"] & 1 << LASER
    arm.set_digital_output(LASER, False)


def test_a_stop_of_an_arm_that_nobody_reaches_says_so_within_the_time_of_a_safe_stop(arm, bench):
    swinging(arm, bench)
    os.kill(arm._session.link.pid, signal.SIGSTOP)
    bench.process.send_signal(signal.SIGSTOP)
    begun = time.monotonic()
    with pytest.raises(DeviceFault, match="not known to be safe") as caught:
        arm.stop()
    assert time.monotonic() - begun < SAFE_STOP_S
    assert caught.value.code == "arm.not_safe"
    bench.process.send_signal(signal.SIGCONT)
    arm.stop()
    assert not bench.ask("show")["moving"]


def course_after(bench, pull, seconds=0.5):
    """What the arm does after `pull()`: seconds until it stands, its way in rad, seconds until the laser is off."""
    before = bench.ask("show")
    pull()
    stands = off = None
    while (shown := bench.ask("show"))["time"] < before["time"] + seconds:
        if not shown["moving"] and stands is None:
            stands = shown["time"] - before["time"]
        if not shown["outputs"] & 1 << LASER and off is None:
            off = shown["time"] - before["time"]
    return stands, float(np.abs(np.array(shown["q"]) - np.array(before["q"])).max()), off


def test_a_pulled_cable_stops_the_arm_in_a_fifth_of_a_second_and_the_laser_stays_off(bench):
    with Cable(bench.address) as cable:
        arm = connect(cable.address)
        for kind in ("joints", "follow"):
            arm.set_digital_output(LASER, True)
            moving = swinging(arm, bench, kind)
            stands, way, off = course_after(bench, cable.pull)
            print(f"{kind}: stands after {stands:.3f} s and {way:.4f} rad, laser off after {off:.3f} s")
            assert stands <= 0.2
            assert way <= 0.1
            assert off <= 0.2
            with pytest.raises(DeviceFault, match="link to the arm"):
                moving.wait(5.0)
            cable.plug()
            assert soon(lambda: not bench.ask("show")["outputs"] & 1 << LASER)
            assert stands_still(bench)
            arm.recover()
            assert not arm.state().digital_outputs & 1 << LASER
            assert not bench.ask("show")["outputs"] & 1 << LASER
            arm.move_joints(HOME, 1.0, 2.0).wait(5.0)
        arm.close()


def test_the_laser_goes_off_with_the_program_and_cannot_be_lit_without_one(arm, bench):
    arm.set_digital_output(LASER, True)
    arm.set_digital_output(LASER + 1, True)
    dashboard(bench.address, "stop")
    assert soon(lambda: bench.ask("show")["outputs"] & 0b11 == 0b10), "the claw keeps its part"
    with pytest.raises(CellError, match="kept low"):
        arm.set_digital_output(LASER, True)
    assert bench.ask("show")["outputs"] & 0b11 == 0b10


def test_an_owner_that_computes_and_does_not_read_for_a_while_does_not_stop_the_arm():
    """Its pipe is full after 0.8 s at this rate: the child has to keep the watchdog quiet all the same."""
    with ArmBench(speed=10.0) as bench:
        arm = UrArm("arm", bench.address, safe_off_outputs=(LASER,), clock=Clock(rate=10.0))
        arm.set_digital_output(LASER, True)
        with arm._session.feed._news:
            Clock().sleep(1.6)
        assert dashboard(bench.address, "running") == ["Program running: true"]
        assert bench.ask("show")["outputs"] & 1 << LASER
        arm.move_joints(arm.state().joints + 0.1, 1.0, 2.0).wait(10.0)
        arm.close()


# --- recovery ---


def test_a_protective_stop_is_unlocked_only_when_a_person_has_confirmed(arm, bench):
    swinging(arm, bench)
    bench.ask("protective_stop")
    assert soon(lambda: arm.state().safety is ArmSafety.PROTECTIVE_STOP)
    with pytest.raises(DeviceFault, match="a person confirms") as caught:
        arm.recover()
    assert caught.value.code == "arm.protective_stop"
    assert arm.state().safety is ArmSafety.PROTECTIVE_STOP
    arm.recover(confirmed=True)
    assert arm.state().safety is ArmSafety.NORMAL


def test_a_recovery_ends_the_old_program_before_it_unlocks_even_if_its_process_hangs(arm, bench):
    """Nobody has confirmed, so it unlocks nothing; whoever then does so at the pendant must not wake the old move."""
    swinging(arm, bench)
    os.kill(arm._session.link.pid, signal.SIGSTOP)
    bench.ask("protective_stop")
    with pytest.raises(DeviceFault, match="a person confirms"):
        arm.recover()
    assert soon(lambda: not bench.ask("show")["moving"])
    bench.ask("clear")
    dashboard(bench.address, "play")
    assert stands_still(bench)
    os.kill(arm._session.link.pid, signal.SIGCONT)
    arm.recover()


def test_a_program_that_a_person_pauses_as_it_has_been_recovered_is_not_begun_once_more(arm, bench):
    before = arm._session.link._reader
    said = []

    def person(snapshot):
        if not said and threading.current_thread() is not before:
            said.extend(dashboard(bench.address, "pause"))
            Clock().sleep(0.3)

    with arm._session.feed.listening(person), pytest.raises(DeviceFault) as caught:
        arm.recover()
    assert said == ["Pausing program"]
    assert caught.value.code == "arm.program_stopped"
    assert "started again" not in arm.statistics.errors
    arm.recover()


@pytest.mark.parametrize("ended_by", ["stop", "close"])
@pytest.mark.usefixtures("closes")
def test_a_recovery_that_is_stopped_neither_unlocks_nor_starts_anything(arm, bench, ended_by):
    swinging(arm, bench)
    bench.ask("protective_stop")
    assert soon(lambda: arm.state().safety is ArmSafety.PROTECTIVE_STOP)
    failures = []

    def recover():
        try:
            arm.recover(confirmed=True)
        except CellError as error:
            failures.append(error)

    recovery = threading.Thread(target=recover)
    recovery.start()
    Clock().sleep(0.05)
    getattr(arm, ended_by)()
    recovery.join(5.0)
    assert [type(failure) for failure in failures] == [Aborted]
    assert dashboard(bench.address, "safetystatus") == ["Safetystatus: PROTECTIVE_STOP"]
    assert dashboard(bench.address, "running") == ["Program running: false"]


def test_a_recovery_that_is_stopped_while_it_connects_leaves_no_program_and_no_process(arm, bench):
    before = children() - {arm._session.link.pid}
    begun = time.monotonic()
    arm.recover()
    lasts = time.monotonic() - begun
    for after in (0.1, 0.5, 0.9):
        failures = []

        def recover(failures=failures):
            try:
                arm.recover()
            except CellError as error:
                failures.append(error)

        recovery = threading.Thread(target=recover)
        recovery.start()
        Clock().sleep(after * lasts)
        arm.stop()
        recovery.join(5.0)
        if failures:
            assert [type(failure) for failure in failures] == [Aborted]
            with pytest.raises(DeviceFault, match=r"not connected again.*arm\.link_lost"):
                arm.state()
            assert soon(lambda: children() <= before)
            assert stands_still(bench)
            assert dashboard(bench.address, "running") == ["Program running: false"]
        arm.recover()
        arm.move_joints(HOME, 1.0, 2.0).wait(5.0)


# --- programs of others ---

FOREIGN = "def foreign():\n  movej([1.5, -1.57, -1.57, -1.57, 1.57, 0.0], a=1.0, v=0.2)\nend\n"


def test_who_only_looks_leaves_a_running_program_and_its_outputs_alone_also_as_it_dies(bench):
    with socket.create_connection((bench.address, 30003), timeout=5.0) as connection:
        connection.sendall(FOREIGN.encode())
        assert soon(lambda: bench.ask("show")["moving"])
    looking = connect(bench.address, control=False)
    assert looking.state().moving
    assert looking.identity().model == "UR10e"
    bench.ask("output 0 1")
    for act in (
        looking.stop,
        looking.recover,
        looking.zero_force,
        lambda: looking.move_joints(HOME, 1.0, 1.0),
        lambda: looking.set_digital_output(LASER, False),
    ):
        with pytest.raises(InterlockError, match="only to be looked at"):
            act()
    looking.close()
    dying = connect(bench.address, control=False)
    os.kill(dying._session.link.pid, signal.SIGKILL)
    assert soon(lambda: dying._session.link.lost is not None)
    dying.close()
    Clock().sleep(0.3)
    shown = bench.ask("show")
    assert shown["moving"]
    assert shown["outputs"] & 1 << LASER
    assert dashboard(bench.address, "running") == ["Program running: true"]


def test_a_connection_that_is_refused_leaves_the_one_that_has_the_arm_alone(arm, bench):
    arm.set_digital_output(LASER, True)
    moving = swinging(arm, bench)
    with pytest.raises(NotConnectedError, match="already in use"):
        connect(bench.address)
    Clock().sleep(0.3)
    shown = bench.ask("show")
    assert shown["moving"]
    assert shown["outputs"] & 1 << LASER
    assert not moving.done


# --- signals ---


def test_a_storm_of_signals_does_not_end_the_child_before_it_has_switched_off(bench):
    for _ in range(2):
        arm = connect(bench.address)
        arm.set_digital_output(LASER, True)
        process = arm._session.link._process
        for count in itertools.count():
            if process.poll() is not None or count > 5000:
                break
            process.send_signal((signal.SIGTERM, signal.SIGHUP)[count % 2])
            Clock().sleep(0.0003)
        assert process.wait(5.0) == 0, "it ended in its own good order"
        assert not bench.ask("show")["outputs"] & 1 << LASER
        arm.close()


# --- the wrong arm ---


def drawn(joints):
    """base_from_flange of a UR10e by the maker's table, as (x, y, z, rx, ry, rz)."""
    return to_ur(flange(joints))


def test_a_dead_link_to_the_arm_ends_what_another_device_does(arm, closes):
    """While the rail sweeps nothing is commanded to the arm, and the sweep must not go on without it."""
    devices = Devices(Clock(), Gate(Interlocks(lambda: None, ())), arm=arm)
    require_healthy(devices)
    os.kill(arm._session.link.pid, signal.SIGKILL)

    def ails():
        with suppress(DeviceFault):
            require_healthy(devices)
            return False
        return True

    assert soon(ails, 0.5)
    with pytest.raises(DeviceFault) as caught:
        require_healthy(devices)
    assert caught.value.code == "arm.link_lost"


@pytest.mark.parametrize("error", [[60e-6, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.12e-3]])
def test_the_model_is_compared_when_it_connects_and_before_every_motion(bench, error):
    pose_error = np.array(error)

    def model(joints):
        pose = drawn(joints)
        turn = pin.log3(pin.exp3(pose_error[3:]) @ pin.exp3(pose[3:]))
        return np.concatenate((pose[:3] + pose_error[:3], turn))

    before = bench.ask("show")["q"]
    with pytest.raises(DeviceFault, match=r"mm and .* mrad away from where the cell's model") as caught:
        connect(bench.address, forward=model)
    assert (caught.value.code, caught.value.recoverable) == ("arm.wrong_kinematics", False)
    assert bench.ask("show")["q"] == before
    assert dashboard(bench.address, "running") == ["Program running: false"]
    pose_error[:] = 0.0
    arm = connect(bench.address, forward=model)
    state = arm.state()
    arm.move_joints(state.joints, 1.0, 1.0).wait(5.0)
    pose_error[:] = error
    for begin in (
        lambda: arm.move_joints(state.joints + 0.1, 1.0, 1.0),
        lambda: arm.move_linear(state.flange + np.array([0, 0, 0.05, 0, 0, 0]), 0.1, 1.0),
        lambda: arm.follow(np.array([0.0, 1.0]), np.stack([state.joints, state.joints + 0.1])),
    ):
        with pytest.raises(DeviceFault) as caught:
            begin()
        assert caught.value.code == "arm.wrong_kinematics"
    assert np.abs(np.array(bench.ask("show")["q"]) - state.joints).max() < 1e-9
    pose_error[:] = 0.8 * np.array(error)
    arm.move_joints(state.joints + 0.05, 1.0, 1.0).wait(5.0)
    arm.close()


def test_a_stop_after_points_that_came_late_is_laid_to_this_computer(arm, bench, closes):
    """The sending process is held up for 40 ms, then the arm stops: the person reads how late its points were."""
    stands = arm.state().joints
    times = np.linspace(0.0, 3.0, 31)
    moving = arm.follow(times, stands + np.outer(times, [0.02, 0, 0, 0, 0, 0]))
    assert soon(lambda: arm.state().moving)
    pid = arm._session.link.pid
    os.kill(pid, signal.SIGSTOP)
    Clock().sleep(0.04)
    os.kill(pid, signal.SIGCONT)
    Clock().sleep(0.05)
    bench.ask("protective_stop")
    with pytest.raises(DeviceFault, match=r"points came \d+ ms late: this computer is too busy") as caught:
        moving.wait(10.0)
    assert caught.value.code == "arm.protective_stop"
    assert "ran into" not in str(caught.value)
    late = int(re.search(r"came (\d+) ms", str(caught.value))[1])
    assert late >= 30
    # Whoever looks at the arm's state, such as the watch over a run, reads the same.
    assert soon(lambda: "this computer is too busy" in arm.state().reason)
