"""A TMCM-1260 stepper module on its serial line: axis and global parameters, motion commands, status codes.

Nine bytes make a request (docs/reference/protocols.md, section 2); an incomplete one is forgotten after a pause.
Numbers and meanings are the module's, with velocities in pps; 15 to 20 are as the vendor's library has them. The serial
number stands in user variable 0 (bank 2), where it is written when a module is put into service.
"""

import dataclasses
import struct
import threading
from collections.abc import Callable
from typing import Any, Protocol

from sim_backends.clock import WorldClock
from sim_backends.faults import RAIL_FAULTS, RAIL_MODEL_FAULTS
from sim_backends.models.rail import RailModel, RailSettings
from sim_backends.peers.server import SerialServer, Take

SETTINGS: dict[int, tuple[str, int, int]] = {
    4: ("max_velocity", 0, 7_999_774), 5: ("max_acceleration", 0, 7_629_278), 12: ("right_stop", 0, 1),
    13: ("left_stop", 0, 1), 15: ("first_acceleration", 0, 7_629_278), 16: ("first_speed", 0, 1_000_000),
    17: ("max_deceleration", 1, 7_629_278), 18: ("last_deceleration", 1, 7_629_278), 26: ("soft_stop", 0, 1),
    140: ("microsteps", 0, 8), 193: ("search_mode", 1, 8), 194: ("search_speed", 1, 7_999_774),
    195: ("switch_speed", 1, 7_999_774), 251: ("reverse_shaft", 0, 1),
}  # fmt: skip
"""Axis parameters that set the motion: number → (setting, smallest, largest value)."""

SEARCH_MODES = (1, 2, 3, 4, 5, 6, 7)
"""Values of axis parameter 193 that this module knows."""

PLAIN: dict[int, tuple[int, int, int]] = {
    6: (128, 0, 255), 7: (8, 0, 255), 14: (0, 0, 1), 19: (0, 0, 7_999_774), 20: (10, 1, 7_999_774), 21: (0, 0, 65535),
    24: (0, 0, 1), 25: (0, 0, 1), 31: (0, 0, 65535), 127: (0, 0, 1), 153: (0, 0, 13), 154: (3, 0, 13),
    181: (0, 0, 7_999_774), 204: (0, 0, 65535), 214: (200, 0, 65535), 254: (0, 0, 0), 255: (1, 1, 1),
}  # fmt: skip
"""Axis parameters that are only remembered: number → (value at power-on, smallest, largest value)."""

GLOBALS: dict[int, tuple[int, int, int]] = {
    65: (0, 0, 11), 66: (1, 1, 255), 68: (0, 0, 65535), 69: (8, 2, 8), 70: (2, 0, 2047), 71: (1, 0, 2047),
    73: (0, 0, 2**31 - 1), 75: (0, 0, 255), 76: (2, 0, 255), 77: (0, 0, 1),
}  # fmt: skip
"""Global parameters of bank 0: number → (value at power-on, smallest, largest value)."""

EEPROM_LOCK, UNLOCK, LOCK = 73, 4321, 1234
"""The global parameter that locks the EEPROM, and its two values."""
USER_VARIABLES = 256
"""Number of variables in bank 2, all of them in RAM and 0 at power-on but for those that were stored."""
STORED_VARIABLES = 56
"""The first so many of them can be stored in the EEPROM, from where they come back at power-on."""
INPUTS = 4


OK, BAD_CHECKSUM, BAD_COMMAND, BAD_TYPE, BAD_VALUE, LOCKED = 100, 1, 2, 3, 4, 5
MODEL = 1260
SERIAL_VARIABLE = 0
FACTORY_RAMP: dict[str, Any] = {
    "max_deceleration": 500_000,
    "first_acceleration": 100_000,
    "last_deceleration": 100_000,
    "first_speed": 10_000,
}
"""How the ramp is when the module is switched on: no trapezium, as long as nobody makes it one."""


class TmclRefused(Exception):
    """A request is answered with the status code `status` instead of 100."""

    def __init__(self, status: int) -> None:
        super().__init__(f"TMCL status {status}")
        self.status = status


class TmclModule:
    """One module with one axis; `handle` may be called from several threads."""

    def __init__(self, rail: RailModel, clock: WorldClock) -> None:
        self.rail = rail
        self.clock = clock
        self._lock = threading.Lock()
        self._globals = {number: value for number, (value, _, _) in GLOBALS.items()}
        self._stored: dict[int, int] = {}
        self._stored_variables = {SERIAL_VARIABLE: rail.params.serial & 0x7FFFFFFF}
        self._power_on()
        self._locked = False
        self._commands: dict[int, Callable[[int, int, int], int]] = {
            1: lambda kind, motor, value: self._rotate(kind, motor, value),
            2: lambda kind, motor, value: self._rotate(kind, motor, -value),
            3: lambda kind, motor, value: self._rotate(kind, motor, 0), 4: self._move, 5: self._set_axis,
            6: self._get_axis, 7: self._store_axis, 8: self._restore_axis, 9: self._set_global, 10: self._get_global,
            11: self._store_global, 12: self._restore_global, 13: self._search, 14: self._set_output,
            15: self._get_input,
        }  # fmt: skip

    def _power_on(self) -> None:
        self._axis = {number: value for number, (value, _, _) in PLAIN.items()}
        self._variables = [self._stored_variables.get(number, 0) for number in range(USER_VARIABLES)]
        self._outputs = [0, 0]
        now = self.clock.now()
        self.rail.configure(now, dataclasses.replace(self.rail.settings, **FACTORY_RAMP))

    def reset(self) -> None:
        """Lose all that is not in the EEPROM: counter, motion, outputs, settings and variables that were not stored."""
        with self._lock:
            self.rail.reset(self.clock.now())
            self._power_on()
            for kind, value in self._stored.items():
                self._set_axis(kind, 0, value)

    def handle(self, request: bytes) -> bytes | None:
        """The reply to nine bytes, or None when they are addressed to another module."""
        address, command, kind, motor, value, checksum = struct.unpack(">BBBBiB", request)
        with self._lock:
            if sum(request[:8]) & 0xFF != checksum:
                return self._reply(BAD_CHECKSUM, command, 0)
            if address != self._globals[66]:
                return None
            if command == 136 and kind == 0:
                major, minor = self.rail.params.firmware
                return bytes([self._globals[76]]) + f"{MODEL:04d}V{major:01d}{minor:02d}".encode("ascii")
            try:
                return self._reply(OK, command, self._run(command, kind, motor, value))
            except TmclRefused as refusal:
                return self._reply(refusal.status, command, 0)

    def _reply(self, status: int, command: int, value: int) -> bytes:
        host, module = self._globals[76], self._globals[66]
        body = bytes((host, module, status, command)) + struct.pack(">i", value)
        return body + bytes([sum(body) & 0xFF])

    def _run(self, command: int, kind: int, motor: int, value: int) -> int:
        if command == 136:
            if kind != 1:
                raise TmclRefused(BAD_TYPE)
            major, minor = self.rail.params.firmware
            return MODEL << 16 | major << 8 | minor
        if command not in self._commands:
            raise TmclRefused(BAD_COMMAND)
        if 1 <= command <= 8 or command == 13:
            _check(motor, 0, 0)
        return self._commands[command](kind, motor, value)

    def _rotate(self, kind: int, motor: int, value: int) -> int:
        _check(abs(value), 0, SETTINGS[4][2])
        self.rail.rotate(self.clock.now(), value)
        return value

    def _move(self, kind: int, motor: int, value: int) -> int:
        if kind not in (0, 1):
            raise TmclRefused(BAD_TYPE)
        t = self.clock.now()
        target = value if kind == 0 else (self.rail.position(t) if self._axis[127] else self.rail.target()) + value
        _check(target, -(2**31), 2**31 - 1)
        self.rail.move_to(t, target)
        return target

    def _search(self, kind: int, motor: int, value: int) -> int:
        t = self.clock.now()
        if kind == 0:
            self.rail.search(t)
        elif kind == 1:
            self.rail.stop_search(t)
        elif kind == 2:
            return int(self.rail.searching(t))
        else:
            raise TmclRefused(BAD_TYPE)
        return 0

    def _get_axis(self, kind: int, motor: int, value: int) -> int:
        rail, t = self.rail, self.clock.now()
        if kind in SETTINGS:
            setting = int(getattr(rail.settings, SETTINGS[kind][0]))
            return 1 - setting if kind in (12, 13) else setting
        if kind in self._axis:
            return self._axis[kind]
        if kind == 207:
            stalled = int(rail.stalled(t))
            rail.clear_stall()
            return stalled
        readings: dict[int, Callable[[], int]] = {
            0: rail.target, 1: lambda: rail.position(t), 2: rail.target_velocity, 3: lambda: rail.velocity(t),
            8: lambda: int(rail.reached(t)), 9: lambda: int(rail.home_switch(t)),
            10: lambda: int(rail.right_switch(t)), 11: lambda: int(rail.left_switch(t)), 29: lambda: rail.velocity(t),
            196: rail.switch_distance, 202: lambda: rail.params.steps_per_turn, 206: lambda: 0,
            208: lambda: int(rail.stalled(t)) | (int(rail.velocity(t) == 0) << 7),
        }  # fmt: skip
        if kind not in readings:
            raise TmclRefused(BAD_TYPE)
        return readings[kind]()

    def _set_axis(self, kind: int, motor: int, value: int) -> int:
        t = self.clock.now()
        if kind in SETTINGS:
            name, low, high = SETTINGS[kind]
            _check(value, low, high)
            if kind == 193 and value not in SEARCH_MODES:
                raise TmclRefused(BAD_VALUE)
            setting: Any = 1 - value if kind in (12, 13) else value
            if isinstance(getattr(RailSettings, name), bool):
                setting = bool(setting)
            self.rail.configure(t, dataclasses.replace(self.rail.settings, **{name: setting}))
        elif kind in PLAIN:
            _check(value, *PLAIN[kind][1:])
            self._axis[kind] = value
        elif kind == 0:
            self.rail.move_to(t, value)
        elif kind == 1:
            self.rail.set_position(t, value)
        elif kind == 2:
            self._rotate(0, motor, value)
        else:
            raise TmclRefused(BAD_TYPE)
        return value

    def _store_axis(self, kind: int, motor: int, value: int) -> int:
        if self._locked:
            raise TmclRefused(LOCKED)
        if kind not in SETTINGS and kind not in PLAIN:
            raise TmclRefused(BAD_TYPE)
        self._stored[kind] = self._get_axis(kind, motor, 0)
        return self._stored[kind]

    def _restore_axis(self, kind: int, motor: int, value: int) -> int:
        if kind not in self._stored:
            raise TmclRefused(BAD_TYPE)
        return self._set_axis(kind, motor, self._stored[kind])

    def _get_global(self, kind: int, bank: int, value: int) -> int:
        if bank == 0 and kind in self._globals:
            return self._globals[kind]
        if bank == 0 and kind == 132:
            return int(self.clock.now() * 1000.0) & 0x7FFFFFFF
        if bank == 2:
            return self._variables[kind]
        raise TmclRefused(BAD_TYPE if bank == 0 else BAD_VALUE)

    def _set_global(self, kind: int, bank: int, value: int) -> int:
        if bank == 2:
            self._variables[kind] = value
        elif bank == 0 and kind in self._globals:
            _check(value, *GLOBALS[kind][1:])
            self._globals[kind] = value
            if kind == EEPROM_LOCK and value in (LOCK, UNLOCK):
                self._locked = value == LOCK
        else:
            raise TmclRefused(BAD_TYPE if bank == 0 else BAD_VALUE)
        return value

    def _store_global(self, kind: int, bank: int, value: int) -> int:
        if self._locked:
            raise TmclRefused(LOCKED)
        if bank == 2:
            if kind >= STORED_VARIABLES:
                raise TmclRefused(BAD_TYPE)
            self._stored_variables[kind] = self._variables[kind]
        return self._get_global(kind, bank, 0)

    def _restore_global(self, kind: int, bank: int, value: int) -> int:
        if bank == 2 and kind < STORED_VARIABLES:
            self._variables[kind] = self._stored_variables.get(kind, 0)
        return self._get_global(kind, bank, 0)

    def _set_output(self, kind: int, bank: int, value: int) -> int:
        _check(bank, 2, 2)
        if kind >= len(self._outputs):
            raise TmclRefused(BAD_TYPE)
        _check(value, 0, 1)
        self._outputs[kind] = value
        return value

    def _get_input(self, kind: int, bank: int, value: int) -> int:
        if bank == 0 and kind < INPUTS:
            return 0
        if bank == 1 and kind in (0, 8, 9):
            return {0: 0, 8: 240, 9: 31}[kind]
        if bank == 2 and kind < len(self._outputs):
            return self._outputs[kind]
        raise TmclRefused(BAD_TYPE if bank in (0, 1, 2) else BAD_VALUE)


def _check(value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise TmclRefused(BAD_VALUE)


LATE_S = 0.2
"""Wall seconds by which `rail.late_reply` delays every reply."""
_REQUEST = 9


class RailController(Protocol):
    """What moves the rail as its protocol says."""

    rail: RailModel
    clock: WorldClock

    def reset(self) -> None:
        """Start anew, as after a loss of power."""


class RailPeer(SerialServer):
    """A rail's controller on its line: at `url` (`socket://127.0.0.1:port` for pyserial), on request at a `pty`."""

    def __init__(self, name: str, controller: RailController, take: Take, *, pty: bool) -> None:
        self._controller = controller
        self._drop = 0
        self._late = False
        self._drop_lock = threading.Lock()
        super().__init__(name, take, pty=pty)

    def fault(self, name: str) -> None:
        """Cause a fault of `RAIL_FAULTS`; ValueError for another name.

        `rail.drop_reply`: the next request is carried out, but its reply is lost. `rail.late_reply`: from now on every
        reply comes `LATE_S` after its request was carried out. `rail.reset`: the controller starts anew. The others
        are the rail's own.
        """
        match name:
            case "rail.drop_reply":
                with self._drop_lock:
                    self._drop += 1
            case "rail.late_reply":
                self._late = True
            case "rail.reset":
                self._controller.reset()
            case _ if name in RAIL_MODEL_FAULTS:
                self._controller.rail.fault(name, self._controller.clock.now())
            case _:
                raise ValueError(f"unknown rail fault {name!r}; known: {', '.join(RAIL_FAULTS)}")

    def clear(self) -> None:
        """Take away all faults; a controller that was reset stays so."""
        with self._drop_lock:
            self._drop = 0
        self._late = False
        self._controller.rail.clear(self._controller.clock.now())

    def reply(self, write: Callable[[bytes], object], data: bytes | None) -> None:
        """Send a reply, if there is one, as late as replies are, unless it is to be lost."""
        if self._late:
            self.stopping.wait(LATE_S)
        if data is None:
            return
        with self._drop_lock:
            lost, self._drop = self._drop > 0, max(0, self._drop - 1)
        if not lost:
            write(data)


class TmclPeer(RailPeer):
    """Serves one module."""

    def __init__(self, model: RailModel, clock: WorldClock, pty: bool = False) -> None:
        self.module = TmclModule(model, clock)
        super().__init__("rail", self.module, self._hear, pty=pty)

    def _hear(self, data: bytes, write: Callable[[bytes], object]) -> bytes:
        while len(data) >= _REQUEST:
            self.reply(write, self.module.handle(data[:_REQUEST]))
            data = data[_REQUEST:]
        return data
