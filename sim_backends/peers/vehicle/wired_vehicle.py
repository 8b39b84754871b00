"""The peer of the vehicle that a drawing has: AgileX v2 unless its wires name another make, or none at all."""

from __future__ import annotations

from sim_backends.models.vehicle import VehicleModel
from sim_backends.peers.vehicle.agilex import AgilexPeer
from sim_backends.peers.vehicle.canopen import CanopenPeer, CanopenSettings
from sim_backends.world.world import World


class FixedFrame:
    """No vehicle: nothing to connect to. Its model stands braked where it was set down."""

    endpoint: dict[str, str] = {}  # noqa: RUF012

    def __init__(self, model: VehicleModel) -> None:
        self._model = model

    def start(self) -> None:
        """Nothing moves it."""

    def stop(self) -> None:
        """Nothing to end."""

    def fault(self, name: str) -> None:
        """It has none: ValueError."""
        raise ValueError(f"{name}: the arm stands on a fixed frame, there is no vehicle that could have it")

    def clear(self) -> None:
        """Nothing to clear."""


VehiclePeer = AgilexPeer | CanopenPeer | FixedFrame


def vehicle_peer(world: World) -> VehiclePeer:
    """The peer; ValueError for a make that none simulates."""
    wire = dict(world.scene.drawing.cell.wires.get("vehicle", {"make": "agilex"}))
    make = wire.pop("make")
    if make == "agilex":
        return AgilexPeer(world.vehicle, world.clock)
    if make == "canopen":
        return CanopenPeer(world.vehicle, world.clock, CanopenSettings(**wire))
    if make == "fixed":
        return FixedFrame(world.vehicle)
    raise ValueError(f"nothing simulates a vehicle of the make {make!r}")
