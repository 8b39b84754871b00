"""The vehicle on CANopen keeps the contract of every vehicle, over its wire."""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from cell.devices.contracts import Bench, VehicleContract
from drivers.clock import Clock
from drivers.interfaces import Vehicle
from drivers.vehicle.cia402.setup import Watchdog
from drivers.vehicle.cia402.vehicle import CanopenVehicle
from sim_backends.clock import WorldClock
from sim_backends.models.vehicle import VehicleModel, VehicleParams
from sim_backends.peers.vehicle.canopen import CanopenPeer
from tests.support.canopen_bench import SETTINGS, TRACK, WHEELS

pytestmark = pytest.mark.wire

SPEED = 3.0


class TestCanopenVehicle(VehicleContract):
    """Two simulated wheel drives behind an slcan adapter."""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Iterator[Bench[Vehicle]]:
        clock = Clock(SPEED)
        model = VehicleModel(VehicleParams(start=(0.0, 0.0, 0.0), track=TRACK), np.random.default_rng(5))
        peer = CanopenPeer(model, WorldClock(SPEED), SETTINGS)
        peer.start()
        made = Bench[Vehicle](
            lambda: CanopenVehicle(
                "vehicle", peer.interface, peer.channel, wheels=WHEELS, watchdog=Watchdog("heartbeat", 0.5, 127),
                max_speed=0.5, max_yaw_rate=0.8, clock=clock,
            ),
            clock,
            faults=SimpleNamespace(cause=peer.fault, clear=peer.clear),
        )  # fmt: skip
        try:
            yield made
        finally:
            made.over()
            peer.stop()
