"""One RTDE connection: the handshakes, the recipes and the packets, in version 1 or 2 of the protocol.

A connection speaks version 1 until it asks for 2: one output recipe without a number in front, sent 500 times a second,
and an input recipe without one as well. Source: the maker's RTDE guide.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from typing import Protocol

from sim_backends.peers.arm.controller_ports import Client
from sim_backends.peers.arm.dashboard import VERSION
from sim_backends.peers.arm.rtde.recipes import InputRecipe, OutputRecipe
from sim_backends.peers.arm.rtde.registers import RegisterView
from sim_backends.peers.arm.rtde.variables import FORMATS, INPUTS, OUTPUTS

_HEADER = struct.Struct(">HB")
_CATCH_UP = 4
"""Every so many calls a second data packet is taken from what has piled up: a quarter faster than it was sent."""
_FLOOD = 65536
"""Bytes from which on everything is taken at once: that is no stream at the controller's rate."""


class Controller(Protocol):
    """What a connection needs of the controller."""

    def claim(self, name: str, session: RtdeSession) -> bool:
        """Give an input variable to a connection; False when another one holds it."""

    def input_recipe(self, names: list[str]) -> InputRecipe:
        """A recipe that writes to this controller's inputs."""


class RtdeSession:
    """One RTDE connection: its recipes and whether it has been started."""

    def __init__(self, controller: Controller, client: Client) -> None:
        self._controller = controller
        self._client = client
        self._buffer = b""
        self._calls = 0
        self._inputs: dict[int, InputRecipe] = {}
        self._outputs: list[OutputRecipe] = []
        self._held: deque[tuple[int, bytes]] = deque()
        self._version = 1
        self.started = False

    def feed(self, data: bytes) -> None:
        """Handle what arrived; a header that cannot be one ends the connection.

        One data packet is taken each tick, now and then a second one: a stream of targets that piled up while the
        machine was busy is then followed about as it was sent, not as one jump. Call with no data in ticks in which
        nothing arrived.
        """
        self._buffer += data
        self._calls += 1
        left = 2 if self._calls % _CATCH_UP == 0 else 1
        while len(self._buffer) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._buffer)
            if size < _HEADER.size:
                self._client.close()
                return
            if len(self._buffer) < size:
                return
            payload, self._buffer = self._buffer[_HEADER.size : size], self._buffer[size:]
            handler = self._HANDLERS.get(chr(kind))
            if handler is not None:
                handler(self, payload)
            left -= chr(kind) == "U"
            if left == 0 and len(self._buffer) < _FLOOD:
                return

    def send_state(self, view: RegisterView, tick: int, late: int = 0) -> None:
        """Send a data packet for every output recipe that is due at this tick, `late` ticks after this one.

        A client that does not keep up misses packets, as it does on a controller.
        """
        for recipe in self._outputs:
            if tick % recipe.every == 0:
                self._held.append((tick, recipe.packet(view)))
        while self._held and self._held[0][0] + late <= tick:
            self._client.offer(self._held.popleft()[1])

    def _reply(self, kind: str, payload: bytes) -> None:
        self._client.send(_HEADER.pack(_HEADER.size + len(payload), ord(kind)) + payload)

    def _on_protocol(self, payload: bytes) -> None:
        known = payload[:2] in (b"\0\1", b"\0\2")
        if known:
            self._version = payload[1]
        self._reply("V", bytes([known]))

    def _on_version(self, payload: bytes) -> None:
        self._reply("v", struct.pack(">4I", *VERSION))

    def _on_outputs(self, payload: bytes) -> None:
        frequency = 0.0
        if self._version > 1:
            frequency = struct.unpack(">d", payload[:8])[0] if len(payload) >= 8 else 0.0
            payload = payload[8:]
        names = _names(payload)
        kinds = [OUTPUTS[name][0] if name in OUTPUTS else "NOT_FOUND" for name in names]
        number = len(self._outputs) + 1
        known = bool(names) and "NOT_FOUND" not in kinds and number < 256
        self._reply_recipe("O", number if known else 0, kinds)
        if known:
            every = max(1, round(500.0 / frequency)) if frequency > 0 else 1
            code = (">HBB" if self._version > 1 else ">HB") + "".join(FORMATS[kind] for kind in kinds)
            getters = tuple(OUTPUTS[name][1] for name in names)
            if self._version == 1:
                self._outputs.clear()
                number = 0
            self._outputs.append(OutputRecipe(number, every, struct.Struct(code), getters))

    def _on_inputs(self, payload: bytes) -> None:
        names = _names(payload)
        kinds = [self._claim(name) for name in names]
        number = len(self._inputs) + 1
        usable = bool(names) and not {"NOT_FOUND", "IN_USE"} & set(kinds) and number < 256
        if usable:
            self._inputs[number] = self._controller.input_recipe(names)
        self._reply_recipe("I", number if usable else 0, kinds)

    def _reply_recipe(self, kind: str, number: int, kinds: list[str]) -> None:
        head = bytes([number]) if self._version > 1 else b""
        self._reply(kind, head + ",".join(kinds).encode())

    def _claim(self, name: str) -> str:
        if name not in INPUTS:
            return "NOT_FOUND"
        return INPUTS[name] if self._controller.claim(name, self) else "IN_USE"

    def _on_start(self, payload: bytes) -> None:
        self.started = True
        self._reply("S", b"\1")

    def _on_message(self, payload: bytes) -> None:
        """A client's words for the controller's log: nobody reads it here."""

    def _on_pause(self, payload: bytes) -> None:
        self.started = False
        self._reply("P", b"\1")

    def _on_data(self, payload: bytes) -> None:
        if self._version == 1:
            recipe = self._inputs.get(len(self._inputs))
        else:
            recipe = self._inputs.get(payload[0]) if payload else None
            payload = payload[1:]
        if recipe is not None:
            recipe.apply(payload)

    _HANDLERS: dict[str, Callable[[RtdeSession, bytes], None]] = {  # noqa: RUF012
        "V": _on_protocol,
        "v": _on_version,
        "O": _on_outputs,
        "I": _on_inputs,
        "S": _on_start,
        "P": _on_pause,
        "U": _on_data,
        "M": _on_message,
    }


def _names(payload: bytes) -> list[str]:
    return [name.strip() for name in payload.decode("ascii", "replace").split(",") if name.strip()]
