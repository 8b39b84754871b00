"""The vehicle's driver with the simulated vehicle's own frames, on a bus inside this process: what must never fail."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import Mock

import can
import numpy as np
import pytest

from cell.devices.gate.interlocks import DeviceCommand, Interlocks, Situation
from cell.devices.gate.rules import RULES
from drivers.clock import Clock
from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, InterlockError, LimitError, NotConnectedError
from drivers.vehicle.agilex import DEAD_MAN_S, AgilexVehicle
from drivers.vehicle.agilex_link import load_database
from drivers.vehicle.feedback import QUIET_S
from sim_backends.clock import WorldClock
from sim_backends.models.vehicle import Mode, VehicleModel, VehicleParams
from sim_backends.peers.vehicle.agilex import AgilexPeer
from sim_backends.peers.vehicle.slcan import CanFrame
from tests.support.inner_bus import Driven, on_inner_bus

RATE = 4.0
TRACK = 0.583


class Bench(Driven):
    """The driver and the vehicle's truth, at `RATE` times the wall."""

    def __init__(self, channel: str) -> None:
        self.channel = channel
        self.world, self.clock = WorldClock(RATE), Clock(RATE)
        params = VehicleParams(start=(0.0, 0.0, 0.0), track=TRACK)
        self.peer = AgilexPeer(VehicleModel(params, np.random.default_rng(5)), self.world)
        self.bus = on_inner_bus(self.peer, channel)
        self.peer.start()
        self.vehicle = self.connect()

    def connect(self) -> AgilexVehicle:
        return AgilexVehicle(
            "vehicle", "virtual", self.channel, track=TRACK, max_speed=0.5, max_yaw_rate=0.8, clock=self.clock
        )

    @contextmanager
    def sending(self, sent: Callable[[CanFrame], CanFrame | None]) -> Iterator[None]:
        """The vehicle's frames come as `sent` makes them, None: not at all."""
        send, frames = self.bus.send, lambda given: [made for frame in given if (made := sent(frame)) is not None]
        self.bus.send = lambda given: send(frames(given))  # type: ignore[method-assign]
        try:
            yield
        finally:
            self.bus.send = send  # type: ignore[method-assign]

    def velocities(self) -> list[bytes]:
        """The commanded velocities that came, as their bytes; zeros are standstill."""
        return [bytes(sent.data) for sent in self.bus.frames if sent.arbitration_id == 0x111]


@pytest.fixture
def bench(request) -> Iterator[Bench]:
    made = Bench(request.node.name)
    try:
        made.vehicle.enable()
        yield made
    finally:
        made.bus.talking = True
        made.vehicle.close()
        made.peer.stop()


def test_the_brake_locks_in_truth_and_then_nothing_drives(bench: Bench):
    bench.drive_until_fast()
    bench.vehicle.brake()
    bench.until(bench.braked)
    assert bench.speed() == 0.0
    bench.bus.frames.clear()
    with pytest.raises(InterlockError, match="the brake is locked"):
        bench.vehicle.drive(0.2, 0.0)
    time.sleep(0.1)
    sent = bench.velocities()
    assert sent, "standing still is commanded on"
    assert set(sent) == {bytes(8)}


def test_a_brake_outside_can_mode_is_not_taken_as_locked(bench: Bench):
    """Under the remote control, say, that has taken over from this program and has handed back."""
    vehicle, model = bench.vehicle, bench.peer.model
    vehicle.brake()
    assert vehicle.state().braked is True
    model.set_mode(bench.world.now(), Mode.STANDBY)
    bench.until(lambda: not vehicle.state().command_mode)
    assert vehicle.state().braked is None
    with pytest.raises(DeviceFault, match="left CAN command"):
        vehicle.check()
    vehicle.brake()
    model.set_mode(bench.world.now(), Mode.CAN)
    bench.until(lambda: vehicle.state().command_mode)
    assert vehicle.state().braked is None
    vehicle.recover()
    assert vehicle.state().braked is True


def test_a_velocity_that_nobody_renews_becomes_zero(bench: Bench):
    bench.drive_until_fast()
    bench.clock.sleep(DEAD_MAN_S + 0.6)
    bench.bus.frames.clear()
    time.sleep(0.1)
    assert set(bench.velocities()) == {bytes(8)}
    bench.until(lambda: bench.speed() == 0.0)


@pytest.mark.parametrize(("speed", "yaw_rate"), [(0.51, 0.0), (-0.51, 0.0), (0.0, 0.81), (0.0, -0.81), (math.nan, 0.0)])
def test_no_velocity_beyond_a_limit_is_sent_in_either_direction(bench: Bench, speed: float, yaw_rate: float):
    with pytest.raises(LimitError, match="nothing was sent"):
        bench.vehicle.drive(speed, yaw_rate)
    bench.bus.frames.clear()
    time.sleep(0.05)
    assert set(bench.velocities()) <= {bytes(8)}


@pytest.mark.parametrize("end", ["stop", "brake", "enable", "close"])
def test_the_last_velocity_is_not_kept_alive_by_whatever_ends_it(bench: Bench, end: str):
    """At once: neither the vehicle's own time limit nor the driver's for a velocity that is not renewed is awaited."""
    bench.drive_until_fast()
    bench.bus.frames.clear()
    getattr(bench.vehicle, end)()
    bench.until(lambda: bytes(8) in bench.velocities())
    sent = bench.velocities()
    still = sent.index(bytes(8))
    assert set(sent[still:]) == {bytes(8)}
    assert still <= 10, "what was on its way already; the driver's limit takes some 25"
    if end != "enable":
        assert abs(bench.speed()) < 0.02
    if end == "close":
        bench.until(bench.braked)


def test_a_stop_that_nobody_confirms_is_told_bars_driving_meanwhile_and_the_brake_locks_all_the_same(bench: Bench):
    bench.until(lambda: bench.vehicle._feedback.stands(0.0))
    bench.bus.talking = False  # its newest word, that it stands, is from before the stop
    problems: list[Exception] = []

    def brake() -> None:
        try:
            bench.vehicle.brake()
        except DeadlineError as error:
            problems.append(error)

    braking = threading.Thread(target=brake)
    braking.start()
    bench.until(lambda: bool(bench.vehicle._stopping))
    with pytest.raises(Aborted, match="a stop is under way"):
        bench.vehicle.drive(0.1, 0.0)
    assert not bench.braked()
    braking.join(5.0)
    assert "did not report standstill" in str(problems[0])
    bench.until(bench.braked)


def test_silence_is_told_to_one_who_drives_within_half_a_second_and_an_old_reading_is_none(bench: Bench):
    bench.drive_until_fast()
    bench.bus.talking = False
    begun = time.monotonic()
    with pytest.raises(DeviceFault, match="no feedback") as caught:
        while time.monotonic() - begun < 3.0:
            bench.vehicle.drive(0.3, 0.0)
            time.sleep(0.01)
    assert time.monotonic() - begun < 1.2
    assert caught.value.code == "vehicle.silent"
    with pytest.raises(DeadlineError, match="old, allowed"):
        bench.vehicle.state()


@pytest.mark.parametrize("take", ["brake", "recover"])
def test_a_brake_that_somebody_else_released_is_not_taken_as_locked(bench: Bench, take: str):
    """Whether this program had taken command or has only braked."""
    getattr(bench.vehicle, take)()
    bench.until(lambda: bench.vehicle.state(1.0).braked is True)
    with can.Bus(channel=bench.channel, interface="virtual") as other:
        message = load_database().get_message_by_name("BrakeCommand")
        data = message.encode({"Locked": 0})
        other.send(can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False))
        bench.until(lambda: bench.vehicle.state(1.0).braked is None)
        bench.vehicle.recover()
        assert bench.vehicle.state(1.0).braked is True


def test_a_parked_vehicle_whose_feedback_is_late_holds_nothing_up_and_one_that_is_silent_does(bench: Bench):
    """A program that computes reads late; the arm retreats all the same, as long as the brake is known to be locked."""
    nothing = Situation(
        None, bench.vehicle, None, None, {}, lambda joints, command: (), lambda joints: None, {}, "", clock=bench.clock
    )
    interlocks = Interlocks(nothing, RULES)
    move = DeviceCommand("arm", "move_joints")
    bench.vehicle.brake()
    interlocks.require(move)
    bench.bus.talking = False
    time.sleep(0.6)
    with pytest.raises(DeadlineError):
        bench.vehicle.state(1.0)
    interlocks.require(move)
    time.sleep(QUIET_S)
    with pytest.raises(DeviceFault, match="no feedback"):
        interlocks.require(move)


def test_a_vehicle_whose_brake_is_open_is_not_taken_as_parked_by_an_old_reading(bench: Bench):
    nothing = Situation(
        None, bench.vehicle, None, None, {}, lambda joints, command: (), lambda joints: None, {}, "", clock=bench.clock
    )
    bench.bus.talking = False
    time.sleep(0.6)
    with pytest.raises(DeadlineError):
        Interlocks(nothing, RULES).require(DeviceCommand("arm", "move_joints"))


def test_a_restart_is_noticed_although_another_node_keeps_talking(bench: Bench):
    """Its counters come back where they were, so that only its silence tells; the bus itself is never silent."""
    before = bench.vehicle.state().interruptions
    with can.Bus(channel=bench.channel, interface="virtual") as other:
        bench.bus.talking = False
        end = time.monotonic() + QUIET_S + 0.3
        while time.monotonic() < end:
            other.send(can.Message(arbitration_id=0x7AB, data=[1, 2, 3], is_extended_id=False))
            time.sleep(0.02)
        with pytest.raises(DeviceFault, match="no feedback"):
            bench.vehicle.check()
        bench.bus.talking = True
        bench.until(lambda: heard(bench.vehicle))
    state = bench.vehicle.state()
    assert state.interruptions == before + 1
    assert state.interruption.startswith("nothing was heard of it for 2")


def heard(vehicle: AgilexVehicle) -> bool:
    try:
        vehicle.state()
    except DeadlineError:
        return False
    return True


@pytest.mark.parametrize("end", ["stop", "brake"])
def test_who_was_stopped_while_it_was_enabled_keeps_its_brake(bench: Bench, end: str, monkeypatch):
    """By another thread, while the vehicle took its time to change its mode."""
    bench.vehicle.brake()
    bench.until(bench.braked)
    take = bench.vehicle._take_command

    def late() -> None:
        take()
        getattr(bench.vehicle, end)()

    monkeypatch.setattr(bench.vehicle, "_take_command", late)
    with pytest.raises(Aborted, match="stopped while it was enabled"):
        bench.vehicle.enable()
    time.sleep(0.3)
    assert bench.braked()
    with pytest.raises(CellError):
        bench.vehicle.drive(0.1, 0.0)


@pytest.mark.parametrize(
    ("answers", "firmware"),
    [
        (0x4A1, "SIMULATED HW2.1 CONTROLLER 204 DRIVERS 110"),
        (0x41A, "hardware 2/1, controller 204, drivers 110"),
        (None, "unknown"),
    ],
    ids=["as the SDK asks", "as the manual has it", "not at all"],
)
def test_its_version_is_told_however_it_answers_and_not_answering_is_no_fault(
    bench: Bench, answers: int | None, firmware: str
):
    with bench.sending(lambda frame: None if frame.id in {0x4A1, 0x41A} - {answers} else frame):
        assert bench.vehicle.identity().firmware == firmware
    assert bench.vehicle.statistics.errors == {}
    bench.vehicle.check()


def test_frames_of_another_length_are_not_read_and_are_told(bench: Bench):
    def short(frame: CanFrame) -> CanFrame:
        return replace(frame, data=frame.data[:-1]) if frame.id == 0x311 else frame

    told = pytest.raises(NotConnectedError, match=r"Odometry did not come; \d+ frames had another length")
    with bench.sending(short), told:
        bench.connect()


def test_an_interrupt_while_it_connects_leaves_no_bus_open(bench: Bench, monkeypatch):
    monkeypatch.setattr(AgilexVehicle, "_wait_for", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        bench.connect()
    assert [thread.name for thread in threading.enumerate()].count("vehicle receiver") == 1


def test_a_person_at_the_remote_control_is_in_charge(bench: Bench):
    def remote(frame: CanFrame) -> CanFrame:
        return replace(frame, data=frame.data[:1] + b"\x03" + frame.data[2:]) if frame.id == 0x211 else frame

    with bench.sending(remote), pytest.raises(DeadlineError, match="remote control"):
        bench.vehicle.enable()


def test_what_other_nodes_send_is_not_the_vehicles(bench: Bench):
    """Long identifiers of its own numbers that say it is fast and in emergency stop, remote requests, errors."""
    wild = {0x211: bytes([1, 3, 0, 1, 255, 255, 0, 9]), 0x221: b"\x7f\xff" * 4, 0x311: b"\x7f\xff\xff\xff" * 2}
    wild |= {0x111: b"\x01\xf4" * 4, 0x131: bytes(8)}
    bench.drive_until_fast()
    with can.Bus(channel=bench.channel, interface="virtual") as other:
        for _ in range(20):
            for identifier, data in wild.items():
                other.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=True))
                other.send(can.Message(arbitration_id=identifier, dlc=8, is_remote_frame=True, is_extended_id=False))
            other.send(can.Message(arbitration_id=0x20000004, dlc=8, data=b"\x00\x04" * 4, is_error_frame=True))
            other.send(can.Message(arbitration_id=0x7FF, data=b"", is_extended_id=False))
            bench.vehicle.drive(0.3, 0.0)
            time.sleep(0.01)
    state = bench.vehicle.state()
    assert state.speed == pytest.approx(0.3, abs=0.005)
    assert state.interruptions == 0 and not state.emergency_stop
    assert bench.vehicle.statistics.errors == {"error_frames": 20}
