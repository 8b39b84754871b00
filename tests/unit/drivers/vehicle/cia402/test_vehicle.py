"""The vehicle on CANopen with its simulated drives, on a bus inside this process: what must never fail."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest

from drivers.errors import ConfigError, DeadlineError, DeviceFault, InterlockError
from drivers.vehicle.cia402.master import last_words
from sim_backends.peers.vehicle.canopen import WheelState
from sim_backends.peers.vehicle.canopen_node import WRONG_VALUE, Abort
from tests.support.canopen_bench import RATE, SETTINGS, WATCHDOG_S, WHEELS, Bench, at_bench, frame, with_output_brake

RAMP_WALL_S = 0.3
"""From 0.3 m/s to standstill, and the time to notice, on the wall at three times its pace."""


@pytest.fixture(scope="module")
def connected() -> Iterator[Bench]:
    """For all tests that leave drives behind which can be enabled again."""
    with at_bench() as made:
        yield made


@pytest.fixture
def bench(connected: Bench) -> Bench:
    connected.peer.clear()
    connected.vehicle.enable()
    return connected


@pytest.fixture
def apart() -> Iterator[Bench]:
    """Not connected yet."""
    made = Bench()
    try:
        yield made
    finally:
        made.peer.stop()


def fault_of(bench: Bench) -> DeviceFault:
    with pytest.raises(DeviceFault) as met:
        bench.drive_on()
    return met.value


def test_it_drives_as_told_stops_and_locks_its_brake(bench: Bench) -> None:
    vehicle = bench.vehicle
    end = time.monotonic() + 0.6
    while time.monotonic() < end:
        vehicle.drive(0.3, 0.4)
        time.sleep(0.01)
    assert (vehicle.state().speed, vehicle.state().yaw_rate) == pytest.approx((0.3, 0.4), abs=0.003)
    vehicle.stop()
    x, y, yaw = bench.peer.model.planar(bench.world.now())
    assert bench.speed() == 0.0
    assert math.hypot(x, y) > 0.2
    bench.until(lambda: (vehicle.state().x, vehicle.state().y) == pytest.approx((x, y), abs=0.001))
    assert vehicle.state().yaw == pytest.approx(yaw, abs=0.001)
    vehicle.drive(0.1, 0.0)  # still enabled
    vehicle.brake()
    assert vehicle.state().braked
    bench.until(bench.braked)
    with pytest.raises(InterlockError, match="the brake is locked"):
        vehicle.drive(0.1, 0.0)
    assert vehicle.state().battery_volts == 26.4


@pytest.mark.parametrize("guarding", ["heartbeat", "node"])
def test_the_drives_stop_by_themselves_when_this_program_is_gone(guarding: str) -> None:
    with at_bench(guarding=guarding) as bench:
        bench.drive_until_fast()
        bench.vehicle._master._closed.set()  # its thread ends as with its process
        bench.vehicle._master._keeper.join()
        gone = time.monotonic()
        bench.until(lambda: bench.speed() == 0.0)
        assert time.monotonic() - gone < WATCHDOG_S + RAMP_WALL_S + 0.2
        bench.until(bench.braked)
        assert [drive.wheel.state for drive in bench.peer.drives] == [WheelState.FAULT] * 2
        # Nothing is left of it that could be closed.
        bench.vehicle._master.bus.close()
        bench.vehicle._closed.set()


def test_a_drive_that_does_not_watch_us_is_refused_before_anything_moves(apart: Bench) -> None:
    apart.peer.drives[1].wheel.connection_lost = lambda: None  # type: ignore[method-assign]
    apart.peer.drives[1].node._lost = lambda: None
    vehicle = apart.connect()
    with pytest.raises(DeviceFault, match=r"the right drive stays enabled.*6007h") as met:
        vehicle.enable()
    assert met.value.code == "vehicle.watchdog"
    with pytest.raises(DeviceFault, match="left drive: our heartbeat stayed away"):
        vehicle.drive(0.1, 0.0)
    vehicle.close()
    assert apart.peer.model.planar(apart.world.now())[0] == 0.0
    assert apart.braked()


def test_one_wheel_alone_never_drives(bench: Bench) -> None:
    """A drive falls silent: the other is stopped long before the first stops by its own watchdog."""
    bench.drive_until_fast()
    bench.peer.fault("can.node_lost")
    fault = fault_of(bench)
    assert fault.code == "vehicle.silent"
    assert "left drive" in str(fault)
    bench.until(lambda: bench.peer.drives[1].wheel.state is not WheelState.ENABLED, 0.1)
    bench.until(lambda: bench.speed() == 0.0)
    with pytest.raises(DeviceFault, match="left drive"):
        bench.vehicle.check()
    bench.peer.clear()
    bench.vehicle.recover()
    assert bench.vehicle.state().braked


def test_an_emergency_is_told_in_words_with_its_remedy(bench: Bench) -> None:
    bench.drive_until_fast()
    bench.peer.drives[1].fault(0x4310)
    fault = fault_of(bench)
    assert (fault.code, fault.recoverable) == ("vehicle.error", False)
    assert "right drive: the drive is too hot, 4310h: let the vehicle stand" in str(fault)
    bench.vehicle.stop()
    assert bench.speed() == pytest.approx(0.0, abs=0.004)
    bench.vehicle.recover()
    bench.vehicle.check()
    assert bench.vehicle.state().trouble == ()


def test_a_second_master_is_noticed_and_the_vehicle_stands(bench: Bench) -> None:
    with bench.other() as other:
        for identifier, data, words in (
            (0x000, bytes((0x80, 0)), "NMT command 80h to node all"),
            (0x080, b"", "SYNC"),
            (0x201, struct.pack("<Hi", 0x0F, 900), "commands node 1"),
            (0x602, bytes.fromhex("2bff600000010000"), "sets values of node 2"),
            (0x77F, bytes((5,)), "has the number 127"),
        ):
            bench.vehicle.enable()
            interrupted = bench.vehicle.state().interruptions
            bench.drive_until_fast()
            other.send(frame(identifier, data))
            fault = fault_of(bench)
            assert (fault.code, fault.recoverable) == ("vehicle.disturbed", False)
            assert words in str(fault)
            bench.until(lambda: bench.speed() == 0.0)
            with pytest.raises(InterlockError):
                bench.vehicle.drive(0.1, 0.0)
            assert bench.vehicle.state().interruptions == interrupted + 1


def test_the_drives_of_a_second_vehicle_under_the_same_numbers_are_named_and_no_stop_is_believed(apart: Bench) -> None:
    """Their counts are 12,000 apart, and they say that they stand."""
    vehicle = apart.connect()
    vehicle.enable()
    apart.drive_until_fast()
    with apart.other() as other:
        senders = [
            other.send_periodic(frame(0x180 + node, struct.pack("<Hib", 0x0237, 12_000, 3)), 0.02 / RATE)
            for node in (1, 2)
        ]
        with pytest.raises(DeviceFault, match="two vehicles report under the same identifiers") as met:
            apart.drive_on(0.5 / RATE + 0.2)
        assert (met.value.code, met.value.recoverable) == ("vehicle.two_vehicles", False)
        with pytest.raises(DeviceFault):
            vehicle.enable()
        for sender in senders:
            sender.stop()
    apart.until(lambda: apart.speed() == 0.0)
    vehicle.close()


def test_drives_that_another_master_commands_are_left_alone(apart: Bench) -> None:
    with apart.other() as other:
        other.send(frame(0x7E))  # nobody's: no harm
        sender = other.send_periodic(frame(0x080), 0.05)
        with pytest.raises(DeviceFault, match="sends SYNC") as met:
            apart.connect()
        sender.stop()
    assert met.value.code == "vehicle.disturbed"
    assert [message for message in apart.peer.inner.frames if message.arbitration_id not in (0x080, 0x7E)] == []


def test_who_only_looks_sets_nothing(apart: Bench) -> None:
    vehicle = apart.connect(look=True)
    state = vehicle.state()
    assert (state.battery_volts, state.braked, state.emergency_stop) == (26.4, None, False)
    assert vehicle.identity().model == "CiA 402, Simulated wheel drive"
    assert vehicle.ping() < 0.5
    vehicle.examine(0.1)
    vehicle.stop()
    vehicle.close()
    # Uploads of values and of the parts of a text; aborts of nothing.
    assert {message.arbitration_id for message in apart.peer.inner.frames} == {0x601, 0x602}
    assert {message.data[0] >> 5 for message in apart.peer.inner.frames} == {2, 3}


def test_a_drive_that_counts_otherwise_than_configured_is_refused(apart: Bench) -> None:
    with pytest.raises(ConfigError, match=r"counts 4096 per turn.*counts_per_turn is 1024"):
        apart.connect(replace(WHEELS, counts=1024))
    with pytest.raises(ConfigError, match=r'measures speed in 0\.1 rpm.*velocity_unit is "rpm"'):
        apart.connect(replace(WHEELS, velocity_unit="rpm"))


def test_units_that_contradict_each_other_end_driving() -> None:
    """A drive that does not say in what it measures: at a tenth of the speed that it counts."""
    made = Bench(replace(SETTINGS, velocity_unit="rpm"))
    for drive in made.peer.drives:
        del drive.node._values[0x60A9, 0]
    try:
        made.connect().enable()
        with pytest.raises(DeviceFault, match=r"speed is 0\.(09\d*|10?\d?) times what its counts say") as met:
            made.drive_on(4.0, 0.05)
        assert met.value.code == "vehicle.units"
        made.until(lambda: made.speed() == 0.0)
    finally:
        made.vehicle.close()
        made.peer.stop()


@pytest.mark.parametrize("locks", [False, True])
def test_a_brake_on_an_output_follows_it(locks: bool) -> None:
    settings, wheels = with_output_brake(locks)
    with at_bench(settings, wheels=wheels) as bench:
        bench.until(lambda: not bench.braked())
        assert {drive._outputs >> 17 & 1 for drive in bench.peer.drives} == {not locks}
        bench.drive_until_fast()
        bench.vehicle.brake()
        bench.until(bench.braked)
        assert {drive._outputs >> 17 & 1 for drive in bench.peer.drives} == {locks}


def test_what_is_said_when_this_program_is_killed_stops_both_and_locks_their_brakes() -> None:
    """Sooner than the drives' own watchdog would."""
    settings, wheels = with_output_brake(locks=True)
    with at_bench(settings, wheels=wheels) as bench, bench.other() as other:
        bench.drive_until_fast()
        bench.vehicle._master._closed.set()
        bench.vehicle._master._keeper.join()
        for identifier, data in last_words(wheels):
            other.send(frame(identifier, data))
        bench.until(lambda: all(drive.wheel.state is not WheelState.ENABLED for drive in bench.peer.drives), 0.15)
        assert {drive._outputs >> 17 for drive in bench.peer.drives} == {1}
        bench.until(lambda: bench.speed() == 0.0)
        bench.vehicle._master.bus.close()
        bench.vehicle._closed.set()


def test_a_value_that_is_not_needed_may_be_refused_and_one_that_is_may_not(apart: Bench) -> None:
    def refuse(value: int) -> None:
        raise Abort(WRONG_VALUE)

    apart.peer.drives[0].node._values[0x605D, 0].write = refuse
    apart.connect().close()
    apart.peer.drives[0].node._values[0x6085, 0].write = refuse
    with pytest.raises(DeviceFault, match=r"node number 1 refuses 6085h \(quick stop deceleration\)") as met:
        apart.connect()
    assert met.value.code == "vehicle.setup"


def test_a_drive_that_was_switched_off_is_set_up_again_and_its_counts_are_not_trusted(bench: Bench) -> None:
    bench.drive_until_fast()
    node = bench.peer.drives[0].node
    bench.peer.drives[0].wheel.state = WheelState.DISABLED
    node._values[0x1800, 1].value |= 1 << 31
    node.boot()
    assert fault_of(bench).code == "vehicle.command_lost"
    assert "left drive was restarted" in bench.vehicle.state(10.0 * WATCHDOG_S + 60.0).interruption
    bench.vehicle.enable()
    bench.drive_until_fast()


def test_an_emergency_stop_is_told_and_cleared_by_a_person_alone(bench: Bench) -> None:
    bench.drive_until_fast()
    bench.peer.fault("vehicle.emergency_stop")
    assert fault_of(bench).code == "vehicle.emergency_stop"
    with pytest.raises(DeviceFault, match="emergency stop is pressed"):
        bench.vehicle.enable()
    bench.peer.clear()
    bench.vehicle.enable()
    bench.drive_until_fast()


def test_drives_that_ignore_a_halt_are_stopped_with_the_quick_stop(bench: Bench) -> None:
    bench.drive_until_fast()
    before = bench.vehicle.statistics.errors.get("quick_stop", 0)
    for drive in bench.peer.drives:
        drive.wheel.deceleration = 1e-3
    bench.vehicle.stop()
    assert abs(bench.vehicle.state().speed) < 0.004
    assert bench.vehicle.statistics.errors["quick_stop"] == before + 1
    for drive in bench.peer.drives:
        drive.wheel.deceleration = 1.0
    with pytest.raises(InterlockError, match="operation is not enabled"):
        bench.vehicle.drive(0.1, 0.0)


def test_nobody_there_is_named(apart: Bench) -> None:
    for drive in apart.peer.drives:
        drive.node.silent = True
    with apart.other() as other:
        sender = other.send_periodic(frame(0x709, b"\5"), 0.05)
        with pytest.raises(DeadlineError, match=r"node 1 does not answer.*nodes heard on this bus: 9.*bit rate"):
            apart.connect()
        sender.stop()
