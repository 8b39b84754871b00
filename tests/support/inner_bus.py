"""What the tests of both vehicles share: a clock moved by hand, a CAN bus in this process, a vehicle driven over it."""

import threading
import time
from collections.abc import Callable
from typing import Any

import can

from drivers.clock import Clock
from sim_backends.clock import WorldClock
from sim_backends.peers.vehicle.slcan import CanFrame
from tests.support import until


class Hand(Clock):
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        super().__init__()
        self.time = 0.0

    def now(self) -> float:
        return self.time


class InnerBus:
    """A virtual bus of python-can instead of the peer's adapters; `frames` are those that the driver has sent. With
    `talking` False the vehicle's frames are lost."""

    def __init__(self, channel: str, receive: Callable[[CanFrame], None]) -> None:
        self.talking = True
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
        for frame in frames if self.talking else ():
            self._bus.send(can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False))

    def _run(self) -> None:
        while not self._closing.is_set():
            if (message := self._bus.recv(0.05)) is not None:
                self.frames.append(message)
                number, data = message.arbitration_id, bytes(message.data)
                self._receive(CanFrame(number, data, message.is_extended_id, message.is_remote_frame, message.dlc))


def on_inner_bus(peer: Any, channel: str) -> InnerBus:
    """Put a simulated vehicle's peer, with its timing and its encoding, on a bus inside this process."""
    peer._bus.stop()
    peer._bus = InnerBus(channel, peer._receive)
    return peer._bus


class Driven:
    """A vehicle's driver and the truth of the `peer` that it drives, by the world's clock."""

    peer: Any
    vehicle: Any
    world: WorldClock

    def speed(self) -> float:
        """True speed of the wheels, m/s."""
        return float(self.peer.model.feedback(self.world.now()).speed)

    def braked(self) -> bool:
        """Whether the vehicle's brake is locked in truth."""
        return bool(self.peer.model.feedback(self.world.now()).braked)

    def until(self, happened: Callable[[], object], timeout: float = 3.0) -> None:
        """Wait for something, at most `timeout` wall seconds."""
        assert until(happened, timeout)

    def drive_until_fast(self) -> None:
        """Drive on until it goes at 0.3 m/s."""
        end = time.monotonic() + 3.0
        while self.speed() < 0.295:
            assert time.monotonic() < end
            self.vehicle.drive(0.3, 0.0)
            time.sleep(0.01)
