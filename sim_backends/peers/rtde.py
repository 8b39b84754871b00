"""RTDE version 2 over TCP: the simulated arm's controller as a client on the network sees it.

One thread advances the arm and serves the real-time, dashboard and script ports every 2 ms on the wall, in that
order, on absolute deadlines. Source: the maker's RTDE guide and the protocol sheet, section 1. Physics is elsewhere.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import select
import signal
import struct
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams
from sim_backends.peers.controller_ports import Client, TcpPorts
from sim_backends.peers.dashboard import BANNER, VERSION, Dashboard
from sim_backends.peers.rtde_registers import FORMATS, INPUTS, OUTPUTS, Getter, InputRecipe, Registers, View
from sim_backends.peers.script import ControlProgram, ScriptText

PERIOD = 0.002
"""Seconds on the wall between two ticks and two packets."""
_CATCH_UP = 25
"""Ticks that are made up for in a burst when the machine was busy; a longer delay is skipped."""
RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT = 30004, 29999, 30003

_log = logging.getLogger(__name__)
_HEADER = struct.Struct(">HB")


@dataclass(frozen=True)
class _OutputRecipe:
    number: int
    every: int
    packer: struct.Struct
    getters: tuple[Getter, ...]

    def packet(self, view: View) -> bytes:
        """One data packet."""
        values: list[float] = []
        for getter in self.getters:
            values += getter(view)
        return self.packer.pack(self.packer.size, ord("U"), self.number, *values)


class _Session:
    """One RTDE connection: its recipes and whether it has been started."""

    def __init__(self, peer: RtdePeer, client: Client) -> None:
        self._peer = peer
        self._client = client
        self._buffer = b""
        self._inputs: dict[int, InputRecipe] = {}
        self._outputs: list[_OutputRecipe] = []
        self.started = False

    def feed(self, data: bytes) -> None:
        """Handle what arrived; a header that cannot be one ends the connection."""
        self._buffer += data
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

    def send_state(self, view: View, tick: int) -> None:
        """Send a data packet for every output recipe that is due at this tick."""
        for recipe in self._outputs:
            if tick % recipe.every == 0:
                self._client.send(recipe.packet(view))

    def _reply(self, kind: str, payload: bytes) -> None:
        self._client.send(_HEADER.pack(_HEADER.size + len(payload), ord(kind)) + payload)

    def _on_protocol(self, payload: bytes) -> None:
        self._reply("V", bytes([payload[:2] in (b"\0\1", b"\0\2")]))

    def _on_version(self, payload: bytes) -> None:
        self._reply("v", struct.pack(">4I", *VERSION))

    def _on_outputs(self, payload: bytes) -> None:
        frequency = struct.unpack(">d", payload[:8])[0] if len(payload) >= 8 else 0.0
        names = _names(payload[8:])
        kinds = [OUTPUTS[name][0] if name in OUTPUTS else "NOT_FOUND" for name in names]
        number = len(self._outputs) + 1
        known = "NOT_FOUND" not in kinds and names
        self._reply("O", bytes([number if known else 0]) + ",".join(kinds).encode())
        if known:
            every = max(1, round(500.0 / frequency)) if frequency > 0 else 1
            code = ">HBB" + "".join(FORMATS[kind] for kind in kinds)
            getters = tuple(OUTPUTS[name][1] for name in names)
            self._outputs.append(_OutputRecipe(number, every, struct.Struct(code), getters))

    def _on_inputs(self, payload: bytes) -> None:
        names = _names(payload)
        kinds = [self._claim(name) for name in names]
        usable = names and not {"NOT_FOUND", "IN_USE"} & set(kinds)
        number = len(self._inputs) + 1 if usable else 0
        if usable:
            self._inputs[number] = self._peer.input_recipe(names)
        self._reply("I", bytes([number & 255]) + ",".join(kinds).encode())

    def _claim(self, name: str) -> str:
        if name not in INPUTS:
            return "NOT_FOUND"
        return INPUTS[name] if self._peer.claim(name, self) else "IN_USE"

    def _on_start(self, payload: bytes) -> None:
        self.started = True
        self._reply("S", b"\1")

    def _on_pause(self, payload: bytes) -> None:
        self.started = False
        self._reply("P", b"\1")

    def _on_data(self, payload: bytes) -> None:
        recipe = self._inputs.get(payload[0]) if payload else None
        if recipe is not None:
            recipe.apply(payload[1:], self._peer.wall_time)

    _HANDLERS: dict[str, Callable[[_Session, bytes], None]] = {  # noqa: RUF012
        "V": _on_protocol,
        "v": _on_version,
        "O": _on_outputs,
        "I": _on_inputs,
        "S": _on_start,
        "P": _on_pause,
        "U": _on_data,
    }


class RtdePeer:
    """The controller of one simulated arm on its own loopback address."""

    def __init__(self, model: ArmModel, clock: WorldClock, host: str | None = None) -> None:
        """Bind the three ports on `host`, or on the first free 127.0.0.x from 127.0.0.2 upward.

        Raises OSError when an address or every address is taken.
        """
        self._model = model
        self._clock = clock
        self._registers = Registers()
        self._view = View(model, self._registers)
        self._program = ControlProgram(model, self._registers, clock)
        self._dashboard = Dashboard(model, self._program)
        self._owners: dict[str, _Session] = {}
        self._sessions: dict[Client, _Session] = {}
        self._scripts: dict[Client, ScriptText] = {}
        self._lines: dict[Client, bytes] = {}
        self._ports = TcpPorts((RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT), host)
        self._tick_count = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="arm controller", daemon=True)
        self.lateness: list[float] = []

    @property
    def address(self) -> str:
        """The loopback address that clients connect to."""
        return self._ports.host

    def start(self) -> None:
        """Begin to serve and to advance the arm."""
        self._thread.start()

    def stop(self) -> None:
        """Close every connection and end the thread; idempotent."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._ports.close()

    def claim(self, name: str, session: _Session) -> bool:
        """Give an input variable to a connection; False when another one holds it."""
        return self._owners.setdefault(name, session) is session

    def input_recipe(self, names: list[str]) -> InputRecipe:
        """A recipe that writes to this controller's inputs."""
        return InputRecipe(names, self._model, self._registers)

    @property
    def wall_time(self) -> float:
        """Seconds on the wall at the newest tick."""
        return self._clock.wall(self._model.time)

    def _run(self) -> None:
        period = PERIOD * self._clock.speed
        due = self._clock.now() + period
        try:
            while not self._stopping.is_set():
                self._clock.sleep_until(due)
                late = self._clock.now() - due
                self._note(late)
                self._tick(due)
                due += period
                if self._clock.now() - due > _CATCH_UP * period:
                    due = self._clock.now()
        finally:
            self._ports.close()

    def _note(self, late: float) -> None:
        self.lateness.append(self._clock.wall(late))
        if len(self.lateness) > 20000:
            del self.lateness[:10000]

    def _tick(self, t: float) -> None:
        self._tick_count += 1
        for port, client, data in self._ports.poll():
            if port == RTDE_PORT:
                self._serve_rtde(client, data)
            elif port == DASHBOARD_PORT:
                self._serve_dashboard(client, data)
            else:
                self._serve_script(client, data)
        self._program.tick()
        self._model.tick(t)
        self._view.runtime_state = self._program.runtime_state
        for session in list(self._sessions.values()):
            if session.started:
                session.send_state(self._view, self._tick_count)

    def _serve_rtde(self, client: Client, data: bytes | None) -> None:
        if data is None:
            session = self._sessions.pop(client, None)
            self._owners = {name: owner for name, owner in self._owners.items() if owner is not session}
            return
        if client not in self._sessions:
            self._sessions[client] = _Session(self, client)
        self._sessions[client].feed(data)

    def _serve_dashboard(self, client: Client, data: bytes | None) -> None:
        if data is None:
            self._lines.pop(client, None)
            return
        if client not in self._lines:
            client.send(BANNER.encode() + b"\n")
        *lines, rest = (self._lines.get(client, b"") + data).split(b"\n")
        self._lines[client] = rest[-4096:]
        for line in lines:
            command = line.decode("utf-8", "replace").strip()
            client.send(self._dashboard.answer(command).encode() + b"\n")
            if command == "quit":
                client.close()

    def _serve_script(self, client: Client, data: bytes | None) -> None:
        if data is None:
            self._scripts.pop(client, None)
            return
        for text in self._scripts.setdefault(client, ScriptText()).feed(data):
            self._program.load(text)


def _names(payload: bytes) -> list[str]:
    return [name.strip() for name in payload.decode("ascii", "replace").split(",") if name.strip()]


def main(arguments: list[str] | None = None) -> None:
    """Serve one arm with exact kinematics until SIGINT, SIGTERM or the end of standard input (with --until-eof)."""
    parser = argparse.ArgumentParser(prog="python -m sim_backends.peers.rtde", description=main.__doc__)
    parser.add_argument("--speed", type=float, default=1.0, help="world seconds per wall second")
    parser.add_argument("--host", default=None, help="loopback address, default: the first free one from 127.0.0.2")
    parser.add_argument("--unlock-delay", type=float, default=5.0, help="world seconds before a stop can be unlocked")
    parser.add_argument("--json", action="store_true", help="announce the address as one JSON line")
    parser.add_argument("--until-eof", action="store_true", help="take commands on standard input and end with it")
    options = parser.parse_args(arguments)
    clock = WorldClock(options.speed)
    model = ArmModel(ArmParams(unlock_delay=options.unlock_delay), np.random.default_rng(0), clock)
    peer = RtdePeer(model, clock, options.host)
    peer.start()
    print(json.dumps({"address": peer.address, "pid": os.getpid()}) if options.json else peer.address, flush=True)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    try:
        if options.until_eof:
            _obey(model, ended)
        else:
            ended.wait()
    finally:
        peer.stop()


def _obey(model: ArmModel, ended: threading.Event) -> None:
    """Carry out lines of standard input: the name of a fault, `clear`, or `input INDEX 0|1`."""
    while not ended.is_set():
        if not select.select([sys.stdin], [], [], 0.2)[0]:
            continue
        line = sys.stdin.readline()
        if not line:
            return
        words = line.split()
        if words == ["clear"]:
            model.clear()
        elif len(words) == 3 and words[0] == "input":
            model.set_digital_input(int(words[1]), words[2] == "1")
        elif words:
            model.fault(words[0])
        print(json.dumps({"ok": True}), flush=True)


if __name__ == "__main__":
    main()
