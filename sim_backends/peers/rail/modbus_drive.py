"""A stepper drive as its Modbus registers show it: which register means what is described to it, as a manual does.

Registers that nothing is known of do not exist. Frames are taken apart and made by pymodbus; the drive is ours.
"""

import dataclasses
import threading
from collections.abc import Callable, Mapping
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.framer import FramerRTU
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersResponse,
    ReadInputRegistersResponse,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterResponse,
)

from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel
from sim_backends.peers.rail.tmcl import RailPeer

SEARCH_RPM, CREEP_RPM = 600.0, 120.0
"""Speeds of a search for the reference switch, which a drive keeps in parameters of its own."""
_ALARM_STALL = 0x0E0
_READ, _READ_INPUT, _WRITE_ONE, _WRITE_SEVERAL = 3, 4, 6, 16


class ModbusDriveServer:
    """The drive of `rail`, described by `wire`: `unit`, `counts_per_turn` and `registers` as `cell.toml` has them."""

    def __init__(self, rail: RailModel, clock: WorldClock, wire: Mapping[str, Any]) -> None:
        self.rail = rail
        self.clock = clock
        self._map: dict[str, Any] = wire["registers"]
        self._turn = int(wire["counts_per_turn"])
        self._lock = threading.Lock()
        self._homed = False
        self._searching = False
        self._written: dict[int, int] = {}
        self._writable = {entry["address"] for entry in self._map["setup"]}
        for name in ("target", "speed", "acceleration", "deceleration"):
            if (entry := self._map[name]) is not None:
                self._writable |= set(range(entry["address"], entry["address"] + entry["words"]))
        self._power_on()

    def reset(self) -> None:
        """Start anew, as after a loss of power: the drive has forgotten its zero and what was written to it."""
        with self._lock:
            self._homed = self._searching = False
            self.rail.reset(self.clock.now())
            self._power_on()

    def _power_on(self) -> None:
        self._written = dict.fromkeys(self._writable, 0)
        t = self.clock.now()
        settings = dataclasses.replace(
            self.rail.settings, microsteps=0, search_mode=5, search_speed=round(SEARCH_RPM / 60.0 * self._turn),
            switch_speed=round(CREEP_RPM / 60.0 * self._turn),
        )  # fmt: skip
        self.rail.configure(t, settings)

    def read(self, address: int, count: int, inputs: bool) -> list[int] | None:
        """`count` holding or input registers from `address` on; None when one of them does not exist."""
        with self._lock:
            self._poll()
            there = self._readable(inputs)
            if any(number not in there for number in range(address, address + count)):
                return None
            return [there[number] for number in range(address, address + count)]

    def _readable(self, inputs: bool) -> dict[int, int]:
        t, rail = self.clock.now(), self.rail
        numbers = {
            "position": rail.position(t),
            "alarm": _ALARM_STALL if rail.stalled(t) else 0,
            "serial": rail.params.serial,
        }
        bits: dict[str, Callable[[], bool]] = {
            "moving": lambda: rail.velocity(t) != 0 or self._searching,
            "homed": lambda: self._homed,
            "fault": lambda: rail.stalled(t),
            "left_switch": lambda: rail.left_switch(t),
            "right_switch": lambda: rail.right_switch(t),
        }
        there: dict[int, int] = {} if inputs else dict(self._written)
        for action in ("start", "home", "stop"):
            if not inputs:
                there.setdefault(self._map[action]["address"], 0)
        for name, value in numbers.items():
            if (entry := self._map[name]) is not None and entry["input"] == inputs:
                words = self._words(value, entry["words"])
                there.update({entry["address"] + k: word for k, word in enumerate(words)})
        for name, told in bits.items():
            if (entry := self._map[name]) is not None and entry["input"] == inputs:
                word = there.get(entry["address"], 0) & ~(1 << entry["bit"])
                there[entry["address"]] = word | (told() == entry["set"]) << entry["bit"]
        return there

    def _poll(self) -> None:
        """A search that has come to its end has found the zero."""
        t = self.clock.now()
        if self._searching and not self.rail.searching(t) and self.rail.velocity(t) == 0:
            self._searching, self._homed = False, True

    def write(self, address: int, values: list[int]) -> bool:
        """Write holding registers; False when one of them does not exist, or cannot be written."""
        with self._lock:
            self._poll()
            given = [
                name for name in ("start", "home", "stop") if self._map[name]["address"] == address and len(values) == 1
            ]
            if given:
                for name in given:
                    if self._map[name]["value"] == values[0]:
                        getattr(self, f"_{name}")(self.clock.now())
                return True
            numbers = range(address, address + len(values))
            if not self._writable.issuperset(numbers):
                return False
            self._written.update(zip(numbers, values, strict=True))
            return True

    def _start(self, t: float) -> None:
        """A positioning, with speed and ramps as written; none while a setting is not as it has to be."""
        if any(self._written[entry["address"]] != entry["value"] for entry in self._map["setup"]):
            return
        up = self._acceleration("acceleration")
        down = self._acceleration("deceleration") if self._map["deceleration"] is not None else up
        speed = self._map["speed"]
        per_turn = {"counts/s": float(self._turn), "rpm": 60.0, "0.1 rpm": 600.0, "1/240 rps": 240.0}[speed["unit"]]
        settings = dataclasses.replace(
            self.rail.settings, max_velocity=round(self._number("speed", signed=False) / per_turn * self._turn),
            max_acceleration=round(up * self._turn), max_deceleration=round(down * self._turn),
        )  # fmt: skip
        self.rail.configure(t, settings)
        self.rail.move_to(t, self._number("target"))

    def _home(self, t: float) -> None:
        self._homed, self._searching = False, True
        self.rail.clear_stall()
        self.rail.search(t)

    def _stop(self, t: float) -> None:
        self._searching = False
        self.rail.rotate(t, 0)

    def _acceleration(self, name: str) -> float:
        """In turns per second, each second."""
        value, unit = max(1, self._number(name, signed=False)), self._map[name]["unit"]
        if unit == "ms to 1000 rpm":
            return 1000.0 / 60.0 / (value / 1000.0)
        return value / {"counts/s^2": float(self._turn), "rpm/s": 60.0, "1/6 rps/s": 6.0}[unit]

    def _number(self, name: str, *, signed: bool = True) -> int:
        entry = self._map[name]
        words = [self._written[entry["address"] + k] for k in range(entry["words"])]
        if self._map["word_order"] == "low first":
            words.reverse()
        return int.from_bytes(b"".join(word.to_bytes(2, "big") for word in words), "big", signed=signed)

    def _words(self, value: int, count: int) -> list[int]:
        data = (value % (1 << 16 * count)).to_bytes(2 * count, "big")
        words = [int.from_bytes(data[k : k + 2], "big") for k in range(0, 2 * count, 2)]
        return words[::-1] if self._map["word_order"] == "low first" else words


class ModbusPeer(RailPeer):
    """Serves one drive."""

    def __init__(self, drive: ModbusDriveServer, unit: int, *, pty: bool = False, echo: bool = False) -> None:
        """With `echo` the line repeats what is sent, as an adapter to two wires does."""
        self.drive = drive
        self._unit = unit
        self._echo = echo
        self._framer = FramerRTU(DecodePDU(True))
        super().__init__("modbus", drive, self._hear, pty=pty)

    def _hear(self, data: bytes, write: Callable[[bytes], object]) -> bytes:
        used, request = self._framer.handleFrame(data, 0, 0)
        if request is None:
            return data[used:]
        if self._echo:
            write(data[:used])
        if request.dev_id != self._unit:
            return data[used:]
        reply = self._answer(request)
        reply.dev_id = self._unit
        self.reply(write, self._framer.buildFrame(reply))
        return data[used:]

    def _answer(self, request: ModbusPDU) -> ModbusPDU:
        function = request.function_code
        if function in (_READ, _READ_INPUT):
            values = self.drive.read(request.address, request.count, function == _READ_INPUT)
            if values is None:
                return ExceptionResponse(function, ExcCodes.ILLEGAL_ADDRESS)
            made = ReadHoldingRegistersResponse if function == _READ else ReadInputRegistersResponse
            return made(registers=values)
        if function in (_WRITE_ONE, _WRITE_SEVERAL):
            if not self.drive.write(request.address, list(request.registers)):
                return ExceptionResponse(function, ExcCodes.ILLEGAL_ADDRESS)
            if function == _WRITE_ONE:
                return WriteSingleRegisterResponse(address=request.address, registers=request.registers)
            return WriteMultipleRegistersResponse(address=request.address, count=len(request.registers))
        return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)
