"""Serves one simulated cell: a seeded world and a peer for each device, each on a free loopback endpoint.

`python -m sim_backends.serve --seed 7 --json` prints one JSON line with every endpoint when all peers are ready and
serves until SIGINT, SIGTERM or, with `--exit-with-stdin`, the end of its standard input.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sim_backends.faults import (
    ARM_FAULTS,
    CAMERA_FAULTS,
    CONTROLLER_FAULTS,
    FAULT_NAMES,
    RAIL_FAULTS,
    TARGET_CAMERA_FAULTS,
    VEHICLE_FAULTS,
)
from sim_backends.models.arm_kinematics import TABLES
from sim_backends.models.vehicle import VehicleModel
from sim_backends.peers.arm.rtde.server import PERIOD, RtdePeer
from sim_backends.peers.camera.frames import FramePeer
from sim_backends.peers.camera.gige import GigePeer
from sim_backends.peers.rail.tmcl import TmclPeer
from sim_backends.peers.server import Peer
from sim_backends.peers.switches import switch_peers
from sim_backends.peers.truth import following_peer, truth_peer
from sim_backends.peers.vehicle.agilex import AgilexPeer
from sim_backends.peers.vehicle.canopen import CanopenPeer, CanopenSettings
from sim_backends.peers.vehicle.slcan import CanPeer
from sim_backends.world.bodies.surfaces import SURFACES
from sim_backends.world.drawing import STOCK, read
from sim_backends.world.following import FOLLOWED, WorldFollowing
from sim_backends.world.levels import LEVELS
from sim_backends.world.world import World, camera_spec, truth

if TYPE_CHECKING:
    from sim_backends.peers.rail.modbus_drive import ModbusPeer

SPEEDS = (0.05, 50.0)
"""World seconds per wall second that can be asked for."""


P = TypeVar("P", bound=Peer)

ARM_LAG = 0.2
"""Seconds on the wall that a picture waits for the arm's model at most."""


def picture(world: World, camera: str, t_mid: float, exposure: float) -> NDArray[np.uint8]:
    """As `World.render`, once the arm's model has come to `t_mid`.

    On a busy machine it lags behind the clock by some ticks, and a moving camera would be shown where it was before. An
    arm that does not come is not waited for longer than `ARM_LAG`.
    """
    clock, waited = world.clock, 0.0
    while world.arm.time < t_mid and waited < ARM_LAG:
        clock.sleep(PERIOD * clock.speed)
        waited += PERIOD
    return world.render(camera, t_mid, exposure)


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


def vehicle_peer(world: World) -> CanPeer | FixedFrame:
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


CAMERAS = ("scan", "target")


class ServedCell:
    """A world and its peers; use it as a context manager, or call `start` and `stop`."""

    def __init__(self, world: World, gige: Collection[str] = (), follow: Collection[str] = ()) -> None:
        """Bind every endpoint of `world`. Raises OSError when no loopback address is free.

        The cameras in `gige`, "scan" or "target", are on GigE Vision, the others on the frame stream protocol. The
        devices in `follow` are real ones, which `world` was made to follow: they have no peer here.
        """
        self.world = world
        clock = world.clock
        self.following = WorldFollowing(world, [name for name in FOLLOWED if name in follow])
        with contextlib.ExitStack() as bound:
            self._arm = None if "arm" in follow else _bound(bound, RtdePeer(world.arm, clock))
            self._rail = None if "rail" in follow else _bound(bound, rail_peer(world))
            self._vehicle = None if "vehicle" in follow else _bound(bound, vehicle_peer(world))
            self._cameras: dict[str, FramePeer | GigePeer] = {
                name: _bound(
                    bound,
                    (GigePeer if name in gige else FramePeer)(
                        f"{name}_camera", clock, partial(self._picture, name), camera_spec(world.scene, name)
                    ),
                )
                for name in CAMERAS
            }
            self._gige = frozenset(gige)
            self._switches, self._switch_endpoints = switch_peers(world)
            for switch in self._switches:
                _bound(bound, switch)
            self._told = _bound(bound, following_peer(world, self.following)) if follow else None
            self._truth = _bound(bound, truth_peer(self.truth, self.fault, self.reset, self.make_ready))
            self._peers = bound.pop_all()
        self._faults = self._fault_actions()

    def _fault_actions(self) -> dict[str, Callable[[], None]]:
        """What causes each fault, by its name; none of devices that are real."""
        arm, rail, vehicle = self._arm, self._rail, self._vehicle
        return {
            **({name: partial(self.world.arm.fault, name.removeprefix("arm.")) for name in ARM_FAULTS} if arm else {}),
            **({name: partial(arm.fault, name) for name in CONTROLLER_FAULTS} if arm else {}),
            **({name: partial(rail.fault, name) for name in RAIL_FAULTS} if rail else {}),
            **({name: partial(vehicle.fault, name) for name in VEHICLE_FAULTS} if vehicle else {}),
            **{name: partial(self._cameras["scan"].fault, name) for name in CAMERA_FAULTS},
            **{
                name: partial(self._cameras["target"].fault, name.removeprefix("target_"))
                for name in TARGET_CAMERA_FAULTS
            },
        }

    def start(self) -> None:
        """Begin to serve; every peer answers when this returns."""
        self.world.warm_up()
        devices = (self._arm, self._rail, self._vehicle, *self._cameras.values(), *self._switches)
        for peer in (*devices, self._told, self._truth):
            if peer is not None:
                peer.start()

    def stop(self) -> None:
        """End every connection and thread; idempotent."""
        self._peers.close()

    def __enter__(self) -> ServedCell:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def endpoints(self) -> dict[str, Any]:
        """Where each device is, as it is printed."""
        scene = self.world.scene
        arm, rail, vehicle = self._arm, self._rail, self._vehicle
        return {
            **({"arm": {"address": arm.address}} if arm else {}),
            **({"rail": {"url": rail.url}} if rail else {}),
            **({"vehicle": vehicle.endpoint} if vehicle else {}),
            **{
                f"{name}_camera": {"address": camera.address, "driver": "gige" if name in self._gige else "stream"}
                for name, camera in self._cameras.items()
            },
            **self._switch_endpoints,
            "truth": {"address": self._truth.address},
            **({"following": {"address": self._told.address}} if self._told else {}),
            "seed": scene.seed,
            "level": scene.level,
            "speed": self.world.clock.speed,
            "surface": self.world.station.ground.name,
            "pid": os.getpid(),
        }

    def fault(self, name: str) -> None:
        """Cause the fault `name`, of the scan camera where it says only `camera.`; ValueError that lists the names."""
        if name not in self._faults:
            known = [known for known in FAULT_NAMES if known in self._faults]
            raise ValueError(f"unknown fault {name!r}; known: {', '.join(known)}")
        self._faults[name]()

    def make_ready(self, text: str) -> None:
        """Make the world ready for the station in a drawing's text; ValueError when it is of another cell."""
        drawing, here = read(text), self.world.scene.drawing
        if replace(drawing, station=here.station).as_json() != here.as_json():
            raise ValueError("this is a job of another cell than the one that is simulated; serve that one")
        self.world.make_ready(drawing.station)

    def reset(self) -> None:
        """Take away every fault's cause."""
        self.world.arm.clear()
        for peer in (self._arm, self._rail, self._vehicle, *self._cameras.values()):
            if peer is not None:
                peer.clear()

    def truth(self) -> dict[str, object]:
        """As `world.truth`, and how real devices were followed where there are any."""
        told = truth(self.world)
        return {**told, "following": self.following.figures()} if self.following.devices else told

    def _picture(self, camera: str, t_mid: float, exposure: float) -> NDArray[np.uint8]:
        """As `picture`; raises `NotFollowed` where real devices do not say where they were."""
        self.following.require(camera, t_mid)
        return picture(self.world, camera, t_mid, exposure)


def _bound(stack: contextlib.ExitStack, peer: P) -> P:
    stack.callback(peer.stop)
    return peer


def main(argv: Sequence[str] | None = None, ready: Callable[[dict[str, object]], None] | None = None) -> int:
    """Serve until told to end; `ready` is told the endpoints first. Exit code 0, or 2 for a wrong option."""
    options = _options(argv)
    # Pictures are computed beside threads that answer devices' requests within milliseconds.
    sys.setswitchinterval(0.0005)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    if options.exit_with_stdin:
        threading.Thread(target=_watch_stdin, args=(ended,), name="stdin", daemon=True).start()
    try:
        drawing = read(options.drawing) if options.drawing else STOCK.with_surface(options.surface)
        drawing = drawing if options.arm is None else drawing.with_arm(options.arm)
        world = World(options.seed, options.level, options.speed, drawing, followed=options.follow)
        cell = ServedCell(world, options.gige, options.follow)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    except OSError as error:
        print(f"no free loopback endpoint: {error}; end other simulated cells and try again", file=sys.stderr)
        return 1
    with cell:
        endpoints = cell.endpoints()
        if ready is not None:
            ready(endpoints)
        print(json.dumps(endpoints) if options.json else _table(endpoints), flush=True)
        ended.wait()
    return 0


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="sim serve", description="Serve a simulated cell over its real protocols.")
    parser.add_argument("--seed", type=int, default=1, help="which world, 0 or greater (default: %(default)s)")
    parser.add_argument("--level", choices=list(LEVELS), default="nominal", help="deviations (default: %(default)s)")
    parser.add_argument("--speed", type=float, default=1.0, help="world seconds per wall second (default: %(default)s)")
    parser.add_argument("--surface", choices=sorted(SURFACES), default="pot", help="what lies at the placement area")
    parser.add_argument("--arm", choices=sorted(TABLES), help="which arm, instead of the one that is drawn")
    parser.add_argument("--drawing", help="the cell and its station, as JSON, instead of the stock cell")
    parser.add_argument("--gige", choices=CAMERAS, action="append", default=[], help="this camera on GigE Vision")
    parser.add_argument(
        "--follow", choices=FOLLOWED, action="append", default=[], help="this device is real, and the world follows it"
    )
    parser.add_argument("--json", action="store_true", help="print the endpoints as one JSON line")
    parser.add_argument("--exit-with-stdin", action="store_true", help="end when standard input does")
    options = parser.parse_args(argv)
    if options.seed < 0:
        parser.error(f"--seed {options.seed} must be 0 or greater")
    if not SPEEDS[0] <= options.speed <= SPEEDS[1]:
        parser.error(
            f"--speed {options.speed:g} must be within {SPEEDS[0]:g} and {SPEEDS[1]:g} world seconds per second"
        )
    return options


def _watch_stdin(ended: threading.Event) -> None:
    # Read the descriptor itself: a thread that waits inside sys.stdin holds a lock that Python's exit wants.
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    ended.set()


def _table(endpoints: dict[str, object]) -> str:
    lines = []
    for name, value in endpoints.items():
        text = " ".join(str(part) for part in value.values()) if isinstance(value, dict) else str(value)
        lines.append(f"{name:14} {text}")
    return "\n".join([*lines, "serving until interrupted (Ctrl-C)"])


if __name__ == "__main__":
    raise SystemExit(main())
