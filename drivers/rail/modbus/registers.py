"""What a Modbus drive's registers mean: the map that its manual gives, as data, and how numbers stand in them.

Addresses are those on the wire, counted from 0. A number of 32 bits takes two registers, in either order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

SPEED_UNITS = {"counts/s": None, "rpm": 60.0, "0.1 rpm": 600.0, "1/240 rps": 240.0}
"""Units that speeds are given to drives in: how many of them are one turn per second; None: the counts of a turn."""
ACCELERATION_UNITS = {"counts/s^2": None, "rpm/s": 60.0, "1/6 rps/s": 6.0}
"""The same for accelerations, of one turn per second each second."""
TIME_UNITS = {"ms to 1000 rpm": 1000.0 * 1000.0 / 60.0}
"""Accelerations given as the time that they take: this divided by turns per second each second."""


@dataclass(frozen=True)
class Number:
    """A number in one or two registers at `address`; `input`: those that can only be read (function 4)."""

    address: int
    words: int = 1
    input: bool = False
    high_first: bool = True

    def encode(self, value: int) -> list[int]:
        """The registers of a number, negative ones as two's complement; `ValueError` when it does not fit."""
        bits = 16 * self.words
        if not -(1 << bits - 1) <= value < 1 << bits:
            raise ValueError(f"{value} does not fit into {bits} bits")
        value &= (1 << bits) - 1
        words = [value & 0xFFFF] if self.words == 1 else [value >> 16, value & 0xFFFF]
        return words if self.high_first else words[::-1]

    def decode(self, registers: Sequence[int], *, signed: bool = True) -> int:
        """The number in these registers."""
        value = 0
        for word in registers if self.high_first else reversed(registers):
            value = value << 16 | word
        bits = 16 * self.words
        return value - (1 << bits) if signed and value >> bits - 1 else value


@dataclass(frozen=True)
class Rate:
    """A speed or an acceleration: `number` of `unit`, a key of one of the tables above."""

    number: Number
    unit: str

    def encode(self, turns: float, counts_per_turn: int) -> int:
        """What stands for `turns` per second, or per second each second: at least 1.

        A time is rounded down and a rate up, so that a ramp is never longer than reckoned.
        """
        if self.unit in TIME_UNITS:
            return max(1, int(TIME_UNITS[self.unit] / turns))
        value = turns * self._per_turn(counts_per_turn)
        return max(1, -int(-value // 1) if self.unit in ACCELERATION_UNITS else round(value))

    def decode(self, value: int, counts_per_turn: int) -> float:
        """Turns per second, or per second each second, that a number stands for."""
        if self.unit in TIME_UNITS:
            return TIME_UNITS[self.unit] / value if value else 0.0
        return value / self._per_turn(counts_per_turn)

    def _per_turn(self, counts_per_turn: int) -> float:
        return {**SPEED_UNITS, **ACCELERATION_UNITS}[self.unit] or float(counts_per_turn)


@dataclass(frozen=True)
class Flag:
    """A bit of a register; it says yes where it is `set`."""

    address: int
    bit: int
    set: bool = True
    input: bool = False

    def decode(self, register: int) -> bool:
        """What the register says."""
        return bool(register >> self.bit & 1) == self.set


@dataclass(frozen=True)
class Action:
    """A command: `value` is written to `address`, then, for drives that look for an edge, `then`."""

    address: int
    value: int
    then: int | None = None

    @property
    def writes(self) -> list[int]:
        """What is written, in this order."""
        return [self.value] if self.then is None else [self.value, self.then]


@dataclass(frozen=True)
class RegisterMap:
    """The registers that the rail needs. `setup` are registers that are set, and read back, before motions.

    `position` and `target` count; `homed` is set by the drive when its search has ended, and lost when it is switched
    off. `speed` and the ramps are taken by the drive when `start` is given.
    """

    position: Number
    target: Number
    speed: Rate
    acceleration: Rate
    start: Action
    home: Action
    stop: Action
    moving: Flag
    homed: Flag
    deceleration: Rate | None = None
    fault: Flag | None = None
    left_switch: Flag | None = None
    right_switch: Flag | None = None
    alarm: Number | None = None
    serial: Number | None = None
    setup: tuple[tuple[int, int], ...] = ()
