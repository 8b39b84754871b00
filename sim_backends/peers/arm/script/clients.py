"""The clients of the script ports: what they send is run, and each hears what its port tells.

Primary (30001) and secondary (30002) tell the state ten times a second, the primary one messages as well, real time
(30003) the state in every cycle. 30011 to 30013 tell the same and take nothing.
"""

from __future__ import annotations

from sim_backends.models.arm import ArmModel, Power, Safety
from sim_backends.peers.arm.controller_ports import Client
from sim_backends.peers.arm.dashboard import VERSION
from sim_backends.peers.arm.real_time_port import real_time_packet
from sim_backends.peers.arm.rtde.registers import RegisterView
from sim_backends.peers.arm.script.port import message, robot_state, safety_message, version_message
from sim_backends.peers.arm.script.script import Announcement, ProgramMemory
from sim_backends.peers.arm.urscript.words import ScriptCollector

_PRIMARY, _SECONDARY, _REAL_TIME = (30001, 30011), (30002, 30012), (30003, 30013)
_READ_ONLY = (30011, 30012, 30013)
SCRIPT_PORTS = (*_PRIMARY, *_SECONDARY, *_REAL_TIME)
_REPORT_EVERY = 50
"""Ticks between two reports on the primary and the secondary port, which come ten times a second."""


class ScriptClients:
    """All connections to `SCRIPT_PORTS` of one controller."""

    def __init__(self, model: ArmModel, program: ProgramMemory, view: RegisterView) -> None:
        self._model = model
        self._program = program
        self._view = view
        self._texts: dict[Client, ScriptCollector] = {}
        self._ports: dict[Client, int] = {}
        self._safety_mode = model.safety_mode

    def serve(self, port: int, client: Client, data: bytes | None) -> None:
        """`data` came from `client` of `port`: b"" for a new one, None for one that has left."""
        if data is None:
            self._texts.pop(client, None)
            self._ports.pop(client, None)
            return
        if client not in self._ports:
            self._ports[client] = port
            if port not in _REAL_TIME:
                client.send(version_message(VERSION))
        if port not in _READ_ONLY:
            for text in self._texts.setdefault(client, ScriptCollector()).feed(data):
                self._take(text)

    def tick(self, count: int) -> None:
        """Tell everybody what is due in the cycle with this number."""
        changed = self._model.safety_mode != self._safety_mode
        self._safety_mode = self._model.safety_mode
        if not self._ports:
            self._program.announcements.clear()
            return
        time = self._model.time
        told = [message(one.kind, one.words, time, one.line, one.column) for one in self._program.announcements]
        self._program.announcements.clear()
        if changed:
            told.append(safety_message(self._safety_mode, time))
            if self._model.safety is Safety.PROTECTIVE_STOP:
                told.append(message("warning", f"Protective stop: {self._model.fault_text}", time))
        # A client that hears of a stop has a state that shows it.
        reports = changed or count % _REPORT_EVERY == 0
        state = packet = b""
        for client, port in self._ports.items():
            if port in _REAL_TIME:
                packet = packet or real_time_packet(self._view)
                client.offer(packet)
                continue
            if reports:
                state = state or robot_state(self._model, self._program.runtime_state, self._view.registers.analog_out)
                client.send(state)
            if told and port in _PRIMARY:
                client.send(b"".join(told))

    def _take(self, text: str) -> None:
        """A script, or one of the controller's own commands. In local control nothing is taken."""
        if not self._model.remote:
            self._program.announcements.append(Announcement("read-only", "the arm is in local control"))
            return
        match " ".join(text.split()).lower():
            case "power on":
                self._model.set_power(max(self._model.power, Power.IDLE))
            case "power off":
                self._program.stop("power off")
                self._model.set_power(Power.OFF)
            case "set robotmode run":
                self._model.set_power(Power.RUNNING)
            case "set unlock protective stop":
                self._model.unlock(at_once=True)
            case "stop program":
                self._program.stop("stopped by a client")
            case "pause program":
                self._program.pause()
            case _:
                self._program.load(text)
