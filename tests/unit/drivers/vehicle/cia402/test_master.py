"""Promises of `drivers.vehicle.cia402.master`."""

import struct

import pytest

from drivers.errors import DeviceFault, InterlockError
from drivers.vehicle.cia402.master import last_words
from sim_backends.peers.vehicle.canopen import WheelState
from tests.support.canopen_bench import Bench, at_bench, fault_of, frame, with_output_brake

pytestmark = pytest.mark.wire


def test_one_wheel_alone_never_drives(bench: Bench):
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


def test_a_second_master_is_noticed_and_the_vehicle_stands(bench: Bench):
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


def test_drives_that_another_master_commands_are_left_alone(apart: Bench):
    with apart.other() as other:
        other.send(frame(0x7E))  # nobody's: no harm
        sender = other.send_periodic(frame(0x080), 0.05)
        with pytest.raises(DeviceFault, match="sends SYNC") as met:
            apart.connect()
        sender.stop()
    assert met.value.code == "vehicle.disturbed"
    assert [message for message in apart.bus.frames if message.arbitration_id not in (0x080, 0x7E)] == []


def test_what_is_said_when_this_program_is_killed_stops_both_and_locks_their_brakes():
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


def test_drives_that_ignore_a_halt_are_stopped_with_the_quick_stop(bench: Bench):
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
