"""A simulated AgileX vehicle on its bus, and python-can at it."""

from collections.abc import Iterator

import can
import numpy as np
import pytest

from sim_backends.clock import WorldClock
from sim_backends.models.vehicle import VehicleModel, VehicleParams
from sim_backends.peers.vehicle.agilex import AgilexPeer
from tests.support.simulator.can_bus import open_bus


@pytest.fixture
def peer(model: VehicleModel, clock: WorldClock) -> Iterator[AgilexPeer]:
    peer = AgilexPeer(model, clock)
    peer.start()
    yield peer
    peer.stop()


@pytest.fixture
def clock() -> WorldClock:
    return WorldClock(4.0)


@pytest.fixture
def model() -> VehicleModel:
    return VehicleModel(VehicleParams(), np.random.default_rng(1))


@pytest.fixture
def bus(peer: AgilexPeer) -> Iterator[can.BusABC]:
    bus = open_bus(peer)
    yield bus
    bus.shutdown()
