"""The CANopen vehicle's driver and its simulated drives on a bus inside this process."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import can
import numpy as np

from drivers.clock import Clock
from drivers.vehicle.cia402.geometry import WheelDrives
from drivers.vehicle.cia402.setup import Watchdog
from drivers.vehicle.cia402.vehicle import CanopenVehicle
from sim_backends.clock import WorldClock
from sim_backends.models.vehicle import VehicleModel, VehicleParams
from sim_backends.peers.canopen import CanopenPeer, CanopenSettings
from sim_backends.peers.slcan import CanFrame

RATE = 3.0
TRACK = 0.58
OWN = 127
WATCHDOG_S = 0.3
CHANNELS = (f"drives {count}" for count in itertools.count())
WHEELS = WheelDrives((1, 2), 0.1, 20.0, 4096, "0.1 rpm", (False, True), TRACK, 0.5, 1.0, stop_input=3)
SETTINGS = CanopenSettings(stop_bit=3)


class InnerBus:
    """A virtual bus of python-can instead of the peer's adapters; `frames` are those that the driver has sent."""

    def __init__(self, channel: str, receive: Callable[[CanFrame], None]) -> None:
        self.frames: list[can.Message] = []
        self._receive = receive
        self._bus = can.Bus(channel=channel, interface="virtual")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._bus.shutdown()

    def send(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            self._bus.send(can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False))

    def _run(self) -> None:
        while not self._closing.is_set():
            if (message := self._bus.recv(0.05)) is not None:
                self.frames.append(message)
                data = bytes(message.data)
                self._receive(CanFrame(message.arbitration_id, data, False, message.is_remote_frame, message.dlc))


class OnInnerBus(CanopenPeer):
    """The simulated drives with their timing and encoding, on a bus inside this process."""

    def __init__(self, model: VehicleModel, clock: WorldClock, settings: CanopenSettings, channel: str) -> None:
        super().__init__(model, clock, settings)
        self._bus.stop()
        self.inner = InnerBus(channel, self._receive)
        self._bus = self.inner  # type: ignore[assignment]


class Bench:
    """The driver, once connected, and the vehicle's truth at `RATE` times the wall."""

    def __init__(self, settings: CanopenSettings = SETTINGS) -> None:
        self.channel = next(CHANNELS)
        self.world, self.clock = WorldClock(RATE), Clock(RATE)
        params = VehicleParams(start=(0.0, 0.0, 0.0), track=TRACK)
        self.peer = OnInnerBus(VehicleModel(params, np.random.default_rng(5)), self.world, settings, self.channel)
        self.peer.start()
        self.vehicle: CanopenVehicle

    def connect(self, wheels: WheelDrives = WHEELS, guarding: Any = "heartbeat", look: bool = False) -> CanopenVehicle:
        self.vehicle = CanopenVehicle(
            "vehicle", "virtual", self.channel, wheels=wheels, watchdog=Watchdog(guarding, WATCHDOG_S, OWN),
            max_speed=0.5, max_yaw_rate=0.8, clock=self.clock, look=look,
        )  # fmt: skip
        return self.vehicle

    def speed(self) -> float:
        """True speed of the wheels, m/s."""
        return self.peer.model.feedback(self.world.now()).speed

    def braked(self) -> bool:
        """Whether the vehicle's brake is locked in truth."""
        return self.peer.model.feedback(self.world.now()).braked

    def until(self, happened: Callable[[], object], timeout: float = 3.0) -> None:
        """Wait for something, at most `timeout` wall seconds."""
        end = time.monotonic() + timeout
        while not happened():
            assert time.monotonic() < end
            time.sleep(0.01)

    def drive_until_fast(self) -> None:
        """Drive on until it goes at 0.3 m/s."""
        end = time.monotonic() + 3.0
        while self.speed() < 0.295:
            assert time.monotonic() < end
            self.vehicle.drive(0.3, 0.0)
            time.sleep(0.01)

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
