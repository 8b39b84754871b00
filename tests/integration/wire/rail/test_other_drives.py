"""The CANopen vehicle's driver against drives of which nobody of this project's simulator has written the protocol."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import can
import pytest

from drivers.clock import Clock
from drivers.errors import DeviceFault
from drivers.vehicle.cia402.feedback import WheelDrives
from drivers.vehicle.cia402.make import look_at_nodes
from drivers.vehicle.cia402.setup import Watchdog
from drivers.vehicle.cia402.vehicle import CanopenVehicle
from tests.support import until
from tests.support.wire.other_drives import OtherDrives
from tests.unit.drivers.vehicle.cia402.test_make import config

pytestmark = pytest.mark.wire

WHEELS = WheelDrives((5, 6), 0.1, 25.0, 10_000, "rpm", (False, True), 0.58, 0.5, 1.0)
CHANNELS = (f"other drives {count}" for count in itertools.count())


class Bench:
    def __init__(self) -> None:
        channel = next(CHANNELS)
        self.drives = OtherDrives(channel)
        self.connect: Callable[[WheelDrives], CanopenVehicle] = lambda wheels: CanopenVehicle(
            "vehicle", "virtual", channel, wheels=wheels, watchdog=Watchdog("heartbeat", 0.3, 127),
            max_speed=0.5, max_yaw_rate=0.8, clock=Clock(),
        )  # fmt: skip
        self.vehicle = self.connect(WHEELS)


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.vehicle.close()
    made.drives.close()


def test_the_nodes_of_a_bus_are_found_by_one_question_each_and_the_others_only_heard(tmp_path: Path) -> None:
    """Neither a network command nor anything for a node that the configuration does not name is sent."""
    channel = next(CHANNELS)
    record = config(tmp_path, left_node="5", right_node="6").model_copy(
        update={"interface": "virtual", "channel": channel}
    )
    drives = OtherDrives(channel)
    with can.Bus(channel=channel, interface="virtual") as bus:
        try:
            bus.send(can.Message(arbitration_id=0x700 + 9, data=b"\x05", is_extended_id=False))
            text, ok = look_at_nodes(record)
            missing, found = look_at_nodes(record.model_copy(update={"right_node": 7}))
            taken = look_at_nodes(record.model_copy(update={"own_node": 5, "left_node": 6, "right_node": 5}))
        finally:
            drives.close()
        sent = {frame.arbitration_id for frame in iter(lambda: bus.recv(0.0), None)}
    assert ok
    assert text.startswith("node 5 answers: profile 402 (vendor 0x26c, product 0x9); node 6 answers: profile 402")
    assert not found and "node 7 does not answer: see its number" in missing
    assert not taken[1] and "node 5, which is to be this program's, is taken" in taken[0]
    assert not {
        identifier
        for identifier in sent
        if identifier in (0x000, 0x080) or (identifier > 0x600 + 7 and identifier < 0x700)
    }


def drive_for(vehicle: CanopenVehicle, seconds: float, speed: float, yaw_rate: float = 0.0) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        vehicle.drive(speed, yaw_rate)
        time.sleep(0.02)


def test_it_is_set_up_drives_and_counts(bench: Bench) -> None:
    vehicle, drives = bench.vehicle, bench.drives
    who = vehicle.identity()
    assert (who.model, who.serial, who.firmware) == ("CiA 402, SERVO-48", "105 and 106", "FIR-v2213")
    vehicle.enable()
    drive_for(vehicle, 0.5, 0.2)
    # 0.2 m/s on a wheel of 0.1 m behind a gear of 25: 477.5 turns a minute, the right motor backwards.
    assert (drives.left.target, drives.right.target) == (477, -477)
    vehicle.stop()
    turns = drives.left.position / 10_000 / 25.0
    assert vehicle.state().x == pytest.approx(turns * 2 * 3.14159265 * 0.1, abs=0.001)
    drive_for(vehicle, 0.3, 0.0, 0.5)
    # 0.145 m/s of the rim backwards on the left, ahead on the right.
    assert (drives.left.target, drives.right.target) == (-346, -346)
    vehicle.brake()
    state = vehicle.state()
    assert state.yaw > 0.1
    assert (state.braked, state.battery_volts) == (True, None)
    assert (drives.left.state, drives.right.state) == ("on", "on")


def test_without_our_heartbeat_they_stop_and_one_that_does_not_is_refused(bench: Bench) -> None:
    """They leave the operational state with it, and tell nothing in PDOs any more."""
    bench.drives.right.deaf = True
    with pytest.raises(DeviceFault, match="right drive stays enabled") as met:
        bench.vehicle.enable()
    assert met.value.code == "vehicle.watchdog"
    assert bench.drives.right.state == "disabled"
    bench.drives.right.deaf = False
    bench.vehicle.enable()
    drive_for(bench.vehicle, 0.2, 0.2)
    bench.drives.left.state = "fault"
    bench.drives.left.node.emcy.send(0x7305, 0x20, b"")
    with pytest.raises(DeviceFault, match="left drive: the encoder fails, 7305h: check the encoder's cable"):
        drive_for(bench.vehicle, 1.0, 0.2)
    assert until(lambda: bench.drives.right.state == "disabled", 1.0)


def test_an_object_that_a_drive_lacks_is_named(bench: Bench) -> None:
    bench.vehicle.close()
    with pytest.raises(DeviceFault, match=r"digital inputs.*cannot be mapped") as met:
        bench.connect(replace(WHEELS, stop_input=3))
    assert met.value.code == "vehicle.setup"
