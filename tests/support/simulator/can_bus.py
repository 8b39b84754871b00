"""Frames on the simulated vehicle's bus, through python-can."""

from collections.abc import Callable

import can

from sim_backends.clock import WorldClock
from sim_backends.peers.vehicle.agilex import AgilexPeer


def message(identifier: int, data: list[int]) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def receive(bus: can.BusABC, wanted: Callable[[can.Message], bool], seconds: float = 20.0) -> can.Message:
    wall = WorldClock()
    while wall.now() < seconds:
        frame = bus.recv(0.1)
        if frame is not None and wanted(frame):
            return frame
    raise AssertionError("the frame did not come within the deadline")


def open_bus(peer: AgilexPeer) -> can.BusABC:
    return can.Bus(interface=peer.interface, channel=peer.channel, bitrate=500_000, sleep_after_open=0)
