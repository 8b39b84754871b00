"""The truth endpoint of a simulated world, for reports and for causing faults; no part of any device.

One JSON object per line each way: {"op": "truth"} → {"ok": true, "truth": {…}}, {"op": "fault", "name": …} and
{"op": "reset"} → {"ok": true}; anything else → {"ok": false, "error": …}.

The endpoint at which a world is told of real devices; no part of any device.

One JSON object per line each way. {"op": "time"} → {"ok": true, "time": world s}. {"op": "begin", "table": [[…]],
"outputs": bits} before the arm's first reading. {"op": "tell", "device": …, "rows": [[…]]} → {"ok": true, "wrenches":
[[…]]}. {"op": "board", "base_from_board": [[…]]}. {"op": "switch", "output": n, "on": …} and {"op": "connector"} →
inputs and outputs as bits, for a laser or claw that is simulated beside a real arm. {"op": "figures"}. Anything else,
and what is wrong, → {"ok": false, "error": …}."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sim_backends.peers.server import TcpServer
from sim_backends.world.following import WorldFollowing
from sim_backends.world.world import World

_LONGEST = 64 * 1024


class TruthPeer:
    """Serves at `address` (`127.0.0.1:port`).

    `truth` gives the whole truth (numbers, strings, lists, arrays); `fault` causes a fault by name and raises
    ValueError for one it does not know; `reset` takes away all faults; `make_ready` makes the world ready for the job
    of a drawing's text, with ValueError for what is none of this cell.
    """

    def __init__(
        self,
        truth: Callable[[], dict[str, object]],
        fault: Callable[[str], None],
        reset: Callable[[], None],
        make_ready: Callable[[str], None],
    ) -> None:
        self._truth, self._fault, self._reset, self._make_ready = truth, fault, reset, make_ready
        self._server = TcpServer("truth", self._serve)
        self.address = self._server.address

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()

    def stop(self) -> None:
        """End all connections and threads; idempotent."""
        self._server.stop()

    def _serve(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as lines:
            while line := lines.readline(_LONGEST):
                reply = self._answer(line)
                connection.sendall(json.dumps(reply, default=_plain).encode("utf-8") + b"\n")

    def _answer(self, line: bytes) -> dict[str, object]:
        try:
            request = json.loads(line)
            operation = request["op"]
        except (ValueError, TypeError, KeyError):
            return _refusal('a request is one line with a JSON object that has "op"')
        if operation == "truth":
            return {"ok": True, "truth": self._truth()}
        if operation in ("fault", "make_ready"):
            try:
                if operation == "fault":
                    self._fault(str(request.get("name")))
                else:
                    self._make_ready(str(request.get("drawing")))
            except ValueError as error:
                return _refusal(str(error))
            return {"ok": True}
        if operation == "reset":
            self._reset()
            return {"ok": True}
        return _refusal(f"unknown op {operation!r}; known: truth, fault, make_ready, reset")


def _refusal(error: str) -> dict[str, object]:
    return {"ok": False, "error": error}


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not fit for JSON")


_LONGEST_READINGS = 4 * 1024 * 1024


class FollowingPeer:
    """Serves at `address` (`127.0.0.1:port`)."""

    def __init__(self, world: World, following: WorldFollowing) -> None:
        self._world, self._following = world, following
        self._server = TcpServer("following", self._serve)
        self.address = self._server.address
        self._operations: dict[str, Callable[[Mapping[str, object]], dict[str, object]]] = {
            "time": lambda request: {"time": world.clock.now()},
            "begin": self._begin,
            "tell": self._tell,
            "board": self._board,
            "switch": self._switch,
            "connector": lambda request: {"inputs": world.arm.digital_inputs, "outputs": world.arm.digital_outputs},
            "figures": lambda request: {"figures": following.figures()},
        }

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()

    def stop(self) -> None:
        """End all connections and threads; idempotent."""
        self._server.stop()

    def _serve(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as lines:
            while line := lines.readline(_LONGEST_READINGS):
                connection.sendall(json.dumps(self._answer(line)).encode() + b"\n")

    def _answer(self, line: bytes) -> dict[str, object]:
        try:
            request = json.loads(line)
            operation = self._operations[request["op"]]
        except (ValueError, TypeError, KeyError):
            return {"ok": False, "error": f'a request has "op", one of {", ".join(self._operations)}'}
        try:
            return {"ok": True, **operation(request)}
        except (ValueError, TypeError, KeyError, IndexError) as error:
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}

    def _begin(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self._following.begin_arm(request["table"], request["outputs"])
        return {}

    def _tell(self, request: Mapping[str, Any]) -> dict[str, Any]:
        return {"wrenches": self._following.tell(request["device"], request["rows"])}

    def _board(self, request: Mapping[str, object]) -> dict[str, object]:
        pose = np.array(request["base_from_board"], dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError("base_from_board is a pose, 4 by 4")
        self._following.board_seen(pose)
        return {}

    def _switch(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self._following.switch(int(request["output"]), bool(request["on"]), self._world.clock.now())
        return {}
