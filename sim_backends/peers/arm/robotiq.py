"""The socket that a Robotiq gripper's program opens on the arm's controller: GET and SET of variables, in text.

Written from the protocol as docs/how-to/other-makes.md, section 3, has it. Replies carry no end mark.
"""

from __future__ import annotations

import socket
import threading

from sim_backends.clock import WorldClock
from sim_backends.peers.server import TcpServer
from sim_backends.world.bodies.gripper import Gripper
from sim_backends.world.world import World

FAULTS = ("claw.overcurrent", "claw.link_lost")
WRITABLE = ("ACT", "GTO", "ATR", "ADR", "FOR", "SPE", "POS")
_OVERCURRENT = 14
_ACTIVATION_S = 1.5
"""World seconds that an activation takes."""


class RobotiqPeer:
    """Serves the gripper of `world` at `address` (`host:port`); active at the start."""

    def __init__(self, world: World, clock: WorldClock) -> None:
        self.gripper = Gripper(world, clock)
        self._clock = clock
        self._lock = threading.Lock()
        self._values = {"ACT": 1, "GTO": 1, "ATR": 0, "ADR": 0, "FOR": 255, "SPE": 255, "POS": 255}
        self._fault = 0
        self._active_at = 0.0
        self._server = TcpServer("robotiq", self._serve)
        self.address = self._server.address

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()

    def stop(self) -> None:
        """End all connections and threads; idempotent."""
        self._server.stop()

    def fault(self, name: str) -> None:
        """Cause a fault of `FAULTS`: the gripper reports that its motor takes too much current, or all connections
        break once. ValueError for another name."""
        match name:
            case "claw.overcurrent":
                self._fault = _OVERCURRENT
            case "claw.link_lost":
                self._server.drop()
            case _:
                raise ValueError(f"unknown claw fault {name!r}; known: {', '.join(FAULTS)}")

    def clear(self) -> None:
        """As a person does at the pendant: clear the fault and activate it; the fingers stay where they are."""
        self._fault = 0
        with self._lock:
            self._values["ACT"] = 1
            self._active_at = self._clock.now()

    def answer(self, line: str) -> str:
        """The reply to one line."""
        words = line.split()
        with self._lock:
            match words:
                case ["GET", name] if (value := self._read(name)) is not None:
                    return f"{name} {value}"
                case ["SET", *pairs] if pairs and len(pairs) % 2 == 0:
                    return "ack" if self._write(dict(zip(pairs[::2], pairs[1::2], strict=True))) else "?"
        return "?"

    def _read(self, name: str) -> int | None:
        if name == "STA":
            return 0 if not self._values["ACT"] else 3 if self._clock.now() >= self._active_at else 1
        if name == "OBJ":
            return self.gripper.finding() if self._values["GTO"] else 0
        if name == "POS":
            return self.gripper.position()
        if name == "PRE":
            return self.gripper.requested
        if name == "FLT":
            return self._fault
        return self._values.get(name)

    def _write(self, pairs: dict[str, str]) -> bool:
        if not all(name in WRITABLE and text.isdecimal() and int(text) <= 255 for name, text in pairs.items()):
            return False
        before = self._values["ACT"]
        self._values.update({name: int(text) for name, text in pairs.items()})
        if self._values["ACT"] and not before:
            self._fault = 0
            self._active_at = self._clock.now() + _ACTIVATION_S
        if not self._values["ACT"]:
            return True
        able = self._values["GTO"] and not self._fault and self._clock.now() >= self._active_at
        if able and ("POS" in pairs or "GTO" in pairs):
            self.gripper.go(self._values["POS"], self._values["SPE"])
        return True

    def _serve(self, connection: socket.socket) -> None:
        pending = b""
        while data := connection.recv(1024):
            pending += data
            while b"\n" in pending:
                line, _, pending = pending.partition(b"\n")
                connection.sendall(self.answer(line.decode("ascii", "replace")).encode())
