"""Promises of `drivers.vehicle.cia402.bus`."""

import struct

import pytest

from drivers.errors import DeadlineError, DeviceFault
from tests.support.canopen_bench import RATE, Bench, fault_of, frame

pytestmark = pytest.mark.wire


def test_an_emergency_is_told_in_words_with_its_remedy(bench: Bench):
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


def test_the_drives_of_a_second_vehicle_under_the_same_numbers_are_named_and_no_stop_is_believed(apart: Bench):
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


def test_nobody_there_is_named(apart: Bench):
    for drive in apart.peer.drives:
        drive.node.silent = True
    with apart.other() as other:
        sender = other.send_periodic(frame(0x709, b"\5"), 0.05)
        with pytest.raises(DeadlineError, match=r"node 1 does not answer.*nodes heard on this bus: 9.*bit rate"):
            apart.connect()
        sender.stop()
