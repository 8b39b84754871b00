"""RTDE version 2 over TCP: the simulated arm's controller as a client on the network sees it.

One thread advances the arm and serves RTDE, the dashboard and the script ports every 2 ms on the wall, on absolute
deadlines. A connection speaks version 1 until it asks for 2: one output recipe without a number in front, sent 500
times a second, and an input recipe without one as well. Sources: the maker's RTDE guide; docs/reference/protocols.md,
section 1. Physics is elsewhere.
"""

import argparse
import logging
import signal
import struct
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sim_backends.clock import WorldClock
from sim_backends.faults import CONTROLLER_FAULTS as FAULTS
from sim_backends.models.arm import ArmModel, ArmParams
from sim_backends.models.arm_kinematics import TABLES
from sim_backends.peers.arm.dashboard import BANNER, VERSION, DashboardServer
from sim_backends.peers.arm.ports import SCRIPT_PORTS, Client, ScriptClients, TcpPorts
from sim_backends.peers.arm.program import ProgramMemory
from sim_backends.peers.arm.rtde.variables import (
    FORMATS,
    INPUTS,
    OUTPUTS,
    InputRecipe,
    OutputRecipe,
    Registers,
    RegisterView,
)

_HEADER = struct.Struct(">HB")
_CATCH_UP = 4
"""Every so many calls a second data packet is taken from what has piled up: a quarter faster than it was sent."""
_FLOOD = 65536
"""Bytes from which on everything is taken at once: that is no stream at the controller's rate."""


class RtdeSession:
    """One RTDE connection: its recipes and whether it has been started."""

    def __init__(self, controller: "RtdePeer", client: Client) -> None:
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
        """Send a data packet for every output recipe that is due at this tick, `late` ticks after this one. A client
        that does not keep up misses packets, as it does on a controller."""
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

    _HANDLERS: "dict[str, Callable[[RtdeSession, bytes], None]]" = {  # noqa: RUF012
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


PERIOD = 0.002
"""Seconds on the wall between two ticks and two packets."""
LATE_S = 0.1
"""Seconds on the wall by which `arm.late_states` delays every state."""
_GIVEN_UP = 100
"""Ticks that are made up for in a burst when the machine was busy; a longer delay is skipped."""
RTDE_PORT, DASHBOARD_PORT = 30004, 29999
_HELD_UP_S = 0.02
"""A tick that begins later than this, in seconds on the wall, is made up for. A real controller is never held up."""

_log = logging.getLogger(__name__)


class RtdePeer:
    """The controller of one simulated arm on its own loopback address."""

    def __init__(
        self, model: ArmModel, clock: WorldClock, host: str | None = None, programs: Path | None = None
    ) -> None:
        """Bind the ports on `host`, or on the first free address of `TcpPorts`; `programs` as for `DashboardServer`.
        Raises OSError when an address or every address is taken."""
        self._model = model
        self._clock = clock
        self._registers = Registers()
        self._view = RegisterView(model, self._registers)
        self._program = ProgramMemory(model, self._registers)
        self._dashboard = DashboardServer(model, self._program, programs)
        self._owners: dict[str, RtdeSession] = {}
        self._sessions: dict[Client, RtdeSession] = {}
        self._scripts = ScriptClients(model, self._program, self._view)
        self._lines: dict[Client, bytes] = {}
        self._ports = TcpPorts((RTDE_PORT, DASHBOARD_PORT, *SCRIPT_PORTS), host)
        self._tick_count = 0
        self._late = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="arm controller", daemon=True)

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

    def fault(self, name: str) -> None:
        """Cause a fault of `FAULTS`; ValueError for another name. `arm.late_states`: from now on every state comes
        `LATE_S` after it was measured and stamped, on all connections."""
        if name not in FAULTS:
            raise ValueError(f"unknown arm fault {name!r}; known: {', '.join(FAULTS)}")
        self._late = round(LATE_S / PERIOD)

    def clear(self) -> None:
        """Take away the fault."""
        self._late = 0

    def claim(self, name: str, session: RtdeSession) -> bool:
        """Give an input variable to a connection; False when another one holds it."""
        return self._owners.setdefault(name, session) is session

    def input_recipe(self, names: list[str]) -> InputRecipe:
        """A recipe that writes to this controller's inputs."""
        return InputRecipe(names, self._model, self._registers)

    def _run(self) -> None:
        period = PERIOD * self._clock.speed
        due = self._clock.now() + period
        try:
            while not self._stopping.is_set():
                self._clock.sleep_until(due)
                late = self._clock.now() - due
                self._tick(due, held_up=self._clock.wall(late) > _HELD_UP_S)
                due += period
                if self._clock.now() - due > _GIVEN_UP * period:
                    due = self._clock.now()
        finally:
            self._ports.close()

    def _tick(self, t: float, held_up: bool) -> None:
        self._tick_count += 1
        waiting = set(self._sessions)
        for port, client, data in self._ports.poll():
            if port == RTDE_PORT:
                waiting.discard(client)
                self._serve_rtde(client, data)
            elif port == DASHBOARD_PORT:
                self._serve_dashboard(client, data)
            else:
                self._scripts.serve(port, client, data)
        for client in waiting:
            self._sessions[client].feed(b"")
        self._program.tick(held_up)
        self._model.tick(t)
        self._view.runtime_state = self._program.runtime_state
        for session in list(self._sessions.values()):
            if session.started:
                session.send_state(self._view, self._tick_count, self._late)
        self._scripts.tick(self._tick_count)

    def _serve_rtde(self, client: Client, data: bytes | None) -> None:
        if data is None:
            session = self._sessions.pop(client, None)
            self._owners = {name: owner for name, owner in self._owners.items() if owner is not session}
            return
        if client not in self._sessions:
            self._sessions[client] = RtdeSession(self, client)
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


def main(arguments: list[str] | None = None) -> None:
    """Serve one arm with exact kinematics until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(prog="python -m sim_backends.peers.arm.rtde.server", description=main.__doc__)
    parser.add_argument("--speed", type=float, default=1.0, help="world seconds per wall second")
    parser.add_argument("--host", default=None, help="loopback address, default: a free one")
    parser.add_argument("--model", choices=sorted(TABLES), default="UR10e", help="which arm")
    parser.add_argument(
        "--programs", type=Path, help="folder of NAME.script files that the dashboard loads as NAME.urp"
    )
    options = parser.parse_args(arguments)
    clock = WorldClock(options.speed)
    model = ArmModel(ArmParams.of(options.model), np.random.default_rng(0), clock)
    peer = RtdePeer(model, clock, options.host, options.programs)
    peer.start()
    print(peer.address, flush=True)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    ended.wait()
    peer.stop()


if __name__ == "__main__":
    main()
