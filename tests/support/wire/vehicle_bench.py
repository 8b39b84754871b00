"""The AgileX vehicle's driver on the simulated CAN bus, beside the vehicle's truth."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from drivers.clock import Clock
from drivers.vehicle.agilex import AgilexVehicle
from sim_backends.clock import WorldClock
from sim_backends.models.vehicle import VehicleModel, VehicleParams
from sim_backends.peers.vehicle.agilex import AgilexPeer

SPEED, TRACK = 5.0, 0.583
STANDSTILL = 0.0025
"""Up to 2 mm/s count as standstill, m/s, and the vehicle reports whole mm/s."""


@dataclass
class Bench:
    """A vehicle on its bus: the driver and the vehicle's truth."""

    vehicle: AgilexVehicle
    model: VehicleModel
    peer: AgilexPeer
    world: WorldClock
    clock: Clock

    def truth(self) -> tuple[float, float, float]:
        """True x, y in m and yaw in rad."""
        return self.model.planar(self.world.now())

    def true_speed(self) -> float:
        """True wheel speed in m/s."""
        return self.model.feedback(self.world.now()).speed

    def drive_for(self, seconds: float, speed: float, yaw_rate: float = 0.0) -> None:
        """Keep driving as a controller does, renewing the command."""
        end = self.clock.now() + seconds
        while self.clock.now() < end:
            self.vehicle.drive(speed, yaw_rate)
            self.clock.sleep(0.05)

    def until(self, happened: Callable[[], bool], timeout: float = 5.0) -> None:
        """Wait for something, at most `timeout` s."""
        end = self.clock.now() + timeout
        while not happened():
            assert self.clock.now() < end
            self.clock.sleep(0.02)


def threads() -> list[str]:
    return [
        thread.name for thread in threading.enumerate() if thread.name in ("vehicle receiver", "vehicle keep-alive")
    ]


@contextmanager
def benched(speed: float) -> Iterator[Bench]:
    world, clock = WorldClock(speed), Clock(speed)
    model = VehicleModel(VehicleParams(start=(0.0, 0.0, 0.0), track=TRACK), np.random.default_rng(5))
    peer = AgilexPeer(model, world)
    peer.start()
    vehicle = AgilexVehicle(
        "vehicle", peer.interface, peer.channel, track=TRACK, max_speed=0.5, max_yaw_rate=0.8, clock=clock
    )
    try:
        yield Bench(vehicle, model, peer, world, clock)
    finally:
        try:
            vehicle.close()
        finally:
            peer.stop()
    assert threads() == []
