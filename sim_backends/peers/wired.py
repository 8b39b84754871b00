"""The peers of devices that a drawing puts on wires of their own, of other makes than the stock cell's.

`Drawing.cell.wires` names for each of them its `make`, and what the peer has to know of how it is wired.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Protocol

from sim_backends.peers.arm.robotiq import RobotiqPeer
from sim_backends.peers.rail.tmcl import TmclPeer
from sim_backends.peers.switches.relays import LcusPeer, NumatoPeer, RelayBoard
from sim_backends.world.world import World

if TYPE_CHECKING:
    from sim_backends.peers.rail.modbus_drive import ModbusPeer


class Peer(Protocol):
    """What every peer offers."""

    def start(self) -> None:
        """Begin to serve."""

    def stop(self) -> None:
        """End all connections and threads; idempotent."""


BOARDS = {"numato": (NumatoPeer, 0), "lcus": (LcusPeer, 1)}
"""Relay boards: their peer, and the number of their first relay."""


def rail_peer(world: World) -> TmclPeer | ModbusPeer:
    """The peer of the rail. Raises ValueError for one on Modbus where pymodbus is not installed."""
    wire = world.scene.drawing.cell.wires.get("rail")
    if wire is None:
        return TmclPeer(world.rail, world.clock)
    try:
        # Only who simulates such a drive needs the library.
        from sim_backends.peers.rail.modbus_drive import ModbusDriveServer, ModbusPeer
    except ImportError as error:
        raise ValueError(
            f"a rail on Modbus is simulated with pymodbus, which is not installed ({error}): pip install "
            "'assembly-cell[modbus]'"
        ) from error
    return ModbusPeer(ModbusDriveServer(world.rail, world.clock, wire), wire["unit"])


def switch_peers(world: World) -> tuple[list[Peer], dict[str, dict[str, object]]]:
    """Peers for laser and claw, and their endpoints by device. Raises ValueError for a make that has none."""
    wires = {name: wire for name, wire in world.scene.drawing.cell.wires.items() if name in ("laser", "claw")}
    peers: list[Peer] = []
    endpoints: dict[str, dict[str, object]] = {}
    # Relays of one board are on one line.
    for make, place in dict.fromkeys((wire["make"], wire["place"]) for wire in wires.values()):
        on_it = {name: wire for name, wire in wires.items() if (wire["make"], wire["place"]) == (make, place)}
        if make == "robotiq":
            gripper = RobotiqPeer(world, world.clock)
            peers.append(gripper)
            endpoints |= {name: {"address": gripper.address} for name in on_it}
        elif make in BOARDS:
            kind, first = BOARDS[make]
            wired = {wire["relay"]: _hanging(world, name) for name, wire in on_it.items()}
            lines: dict[int, Callable[[], bool]] = {
                wire["feedback"]: partial(_grip, world, wire["active_high"])
                for wire in on_it.values()
                if "feedback" in wire
            }
            board = kind(RelayBoard(wired, lines, first))
            peers.append(board)
            endpoints |= {name: {"url": board.url} for name in on_it}
        else:
            raise ValueError(f"nothing simulates a switch of the make {make!r}")
    return peers, endpoints


def _hanging(world: World, name: str) -> tuple[Callable[[bool], None], Callable[[], bool]]:
    return partial(world.switch, name), partial(world.switches.__getitem__, name)


def _grip(world: World, active_high: bool) -> bool:
    return world.part.held == active_high
