"""The CANopen vehicle's driver and its simulated drives on a bus inside this process."""

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import can
import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import DeviceFault
from drivers.vehicle.cia402.feedback import WheelDrives
from drivers.vehicle.cia402.setup import Watchdog
from drivers.vehicle.cia402.vehicle import CanopenVehicle
from sim_backends.clock import WorldClock
from sim_backends.models.vehicle import VehicleModel, VehicleParams
from sim_backends.peers.vehicle.canopen import CanopenPeer, CanopenSettings
from tests.support.inner_bus import Driven, on_inner_bus

RATE = 3.0
TRACK = 0.58
OWN = 127
WATCHDOG_S = 0.3
CHANNELS = (f"drives {count}" for count in itertools.count())
WHEELS = WheelDrives((1, 2), 0.1, 20.0, 4096, "0.1 rpm", (False, True), TRACK, 0.5, 1.0, stop_input=3)
SETTINGS = CanopenSettings(stop_bit=3)


class Bench(Driven):
    """The driver, once connected, and the vehicle's truth at `RATE` times the wall."""

    def __init__(self, settings: CanopenSettings = SETTINGS) -> None:
        self.channel = next(CHANNELS)
        self.world, self.clock = WorldClock(RATE), Clock(RATE)
        params = VehicleParams(start=(0.0, 0.0, 0.0), track=TRACK)
        self.peer = CanopenPeer(VehicleModel(params, np.random.default_rng(5)), self.world, settings)
        self.bus = on_inner_bus(self.peer, self.channel)
        self.peer.start()
        self.vehicle: CanopenVehicle

    def connect(self, wheels: WheelDrives = WHEELS, guarding: Any = "heartbeat", look: bool = False) -> CanopenVehicle:
        self.vehicle = CanopenVehicle(
            "vehicle", "virtual", self.channel, wheels=wheels, watchdog=Watchdog(guarding, WATCHDOG_S, OWN),
            max_speed=0.5, max_yaw_rate=0.8, clock=self.clock, look=look,
        )  # fmt: skip
        return self.vehicle

    def drive_on(self, seconds: float = 2.0, speed: float = 0.3) -> None:
        """Keep driving so many wall seconds, or until that raises."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.vehicle.drive(speed, 0.0)
            time.sleep(0.01)

    @contextmanager
    def other(self) -> Iterator[can.BusABC]:
        """Somebody else on the bus."""
        with can.Bus(channel=self.channel, interface="virtual") as bus:
            yield bus


@contextmanager
def at_bench(settings: CanopenSettings = SETTINGS, **connecting: Any) -> Iterator[Bench]:
    """A bench with a vehicle that is enabled."""
    made = Bench(settings)
    try:
        made.connect(**connecting).enable()
        yield made
    finally:
        made.peer.clear()
        if hasattr(made, "vehicle"):
            made.vehicle.close()
        made.peer.stop()


def frame(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def with_output_brake(locks: bool) -> tuple[CanopenSettings, WheelDrives]:
    """Brakes on output 17 of the drives."""
    settings = replace(SETTINGS, brake_bit=17, brake_locks=locks)
    return settings, replace(WHEELS, brake_output=17, brake_locks=locks)


def fault_of(bench: Bench) -> DeviceFault:
    """What ends a drive that goes on."""
    with pytest.raises(DeviceFault) as met:
        bench.drive_on()
    return met.value
