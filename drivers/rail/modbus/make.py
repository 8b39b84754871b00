"""The rail on a Modbus RTU drive: its record in `cell.toml`, with the register map that the drive's manual gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import StringConstraints, model_validator

from drivers.common.addresses import Port
from drivers.common.units import whole
from drivers.errors import UNTOLD
from drivers.make import AnyMake, Late, Make, RailConfig, Surroundings, Table, with_endpoint

if TYPE_CHECKING:
    from drivers.rail.modbus.rail import ModbusRail

BAUDS = (4800, 9600, 19200, 38400, 57600, 115200, 230400)
COUNTS = 2**31 - 1

Address = Annotated[int, whole(0, 0xFFFF, meaning=": a register's address on the wire, from 0 (0x6002 may be written)")]
Word = Annotated[int, whole(0, 0xFFFF)]


SPEED_UNITS = {"counts/s": None, "rpm": 60.0, "0.1 rpm": 600.0, "1/240 rps": 240.0}
"""Units that speeds are given to drives in: how many of them are one turn per second; None: the counts of a turn."""
ACCELERATION_UNITS = {"counts/s^2": None, "rpm/s": 60.0, "1/6 rps/s": 6.0}
"""The same for accelerations, of one turn per second each second."""
TIME_UNITS = {"ms to 1000 rpm": 1000.0 * 1000.0 / 60.0}
"""Accelerations given as the time that they take: this divided by turns per second each second."""


class NumberConfig(Table):
    """A number in one register, or in two."""

    address: Address
    words: Annotated[int, whole(1, 2, meaning=" registers of 16 bits")] = 2
    input: bool = False

    def encode(self, value: int, *, signed: bool = False) -> list[int]:
        """The registers, high word first, negative numbers as two's complement; `ValueError` when it does not fit."""
        bits = 16 * self.words
        if not -(1 << bits - 1) <= value < 1 << bits - signed:
            raise ValueError(f"{value} does not fit into {bits} bits{' with a sign' if signed else ''}")
        value &= (1 << bits) - 1
        return [value & 0xFFFF] if self.words == 1 else [value >> 16, value & 0xFFFF]

    def decode(self, registers: Sequence[int], *, signed: bool = True) -> int:
        """The number in these registers, high word first."""
        value = 0
        for word in registers:
            value = value << 16 | word
        bits = 16 * self.words
        return value - (1 << bits) if signed and value >> bits - 1 else value


class _Rate(NumberConfig):
    """A speed or an acceleration in the drive's unit, a key of one of the tables above."""

    words: Annotated[int, whole(1, 2)] = 1
    unit: str

    def units(self, turns: float, counts_per_turn: int) -> int:
        """What stands for `turns` per second, or per second each second: at least 1.

        A time is rounded down and a rate up, so that a ramp is never longer than reckoned.
        """
        if self.unit in TIME_UNITS:
            return max(1, int(TIME_UNITS[self.unit] / turns))
        value = turns * self._per_turn(counts_per_turn)
        return max(1, -int(-value // 1) if self.unit in ACCELERATION_UNITS else round(value))

    def turns(self, value: int, counts_per_turn: int) -> float:
        """Turns per second, or per second each second, that a number stands for."""
        if self.unit in TIME_UNITS:
            return TIME_UNITS[self.unit] / value if value else 0.0
        return value / self._per_turn(counts_per_turn)

    def _per_turn(self, counts_per_turn: int) -> float:
        return {**SPEED_UNITS, **ACCELERATION_UNITS}[self.unit] or float(counts_per_turn)


class SpeedConfig(_Rate):
    """A speed in the drive's unit."""

    unit: Literal["counts/s", "rpm", "0.1 rpm", "1/240 rps"]


class AccelerationConfig(_Rate):
    """An acceleration in the drive's unit, or the time that it takes to 1000 turns a minute."""

    unit: Literal["counts/s^2", "rpm/s", "1/6 rps/s", "ms to 1000 rpm"]


class FlagConfig(Table):
    """A bit, counted from 0, of a register of 16 bits; it says yes where it is `set`."""

    address: Address
    bit: Annotated[int, whole(0, 15)]
    set: bool = True
    input: bool = False

    def decode(self, register: int) -> bool:
        """What the register says."""
        return bool(register >> self.bit & 1) == self.set


class ActionConfig(Table):
    """A command: `value` is written, and then, for drives that look for an edge, `then`."""

    address: Address
    value: Word
    then: Word | None = None

    @property
    def writes(self) -> list[int]:
        """What is written, in this order."""
        return [self.value] if self.then is None else [self.value, self.then]


class SetupConfig(Table):
    """A register that has to hold a value, such as the mode of a path or the way of homing."""

    address: Address
    value: Word


class RegistersConfig(Table):
    """What stands where in the drive, at addresses as they are on the wire. `setup` is set before motions.

    `position` and `target` count; `homed` is set by the drive when its search has ended, and lost when it is switched
    off. `speed` and the ramps are taken by the drive when `start` is given.
    """

    word_order: Literal["high first", "low first"] = "high first"
    position: NumberConfig
    target: NumberConfig
    speed: SpeedConfig
    acceleration: AccelerationConfig
    deceleration: AccelerationConfig | None = None
    start: ActionConfig
    home: ActionConfig
    stop: ActionConfig
    moving: FlagConfig
    homed: FlagConfig
    fault: FlagConfig | None = None
    left_switch: FlagConfig | None = None
    right_switch: FlagConfig | None = None
    alarm: NumberConfig | None = None
    serial: NumberConfig | None = None
    setup: tuple[SetupConfig, ...] = ()

    @model_validator(mode="after")
    def _apart(self) -> Self:
        taken: dict[tuple[bool, int], str] = {}
        for name in ("position", "target", "speed", "acceleration", "deceleration", "alarm", "serial"):
            number: NumberConfig | None = getattr(self, name)
            for address in () if number is None else range(number.address, number.address + number.words):
                other = taken.setdefault((number is not None and number.input, address), name)
                if other != name:
                    raise ValueError(
                        f"{other} and {name} both use register {address:#06x}; compare addresses and words with the "
                        "drive's manual"
                    )
        for name in ("target", "speed", "acceleration", "deceleration"):
            if (written := getattr(self, name)) is not None and written.input:
                raise ValueError(f"{name}: input registers cannot be written; leave input out")
        return self


class ModbusRailConfig(RailConfig):
    """A rail on a drive that speaks Modbus RTU on a serial line; `unit` is the drive's number on it."""

    ADDRESS: ClassVar[str] = "url"
    CAUTION: ClassVar[str] = (
        "a drive whose cable is cut goes on to its target: set its own communication timeout, if it has one"
    )

    driver: Literal["modbus"] = "modbus"
    url: Annotated[str, Port]
    unit: Annotated[int, whole(1, 247)] = 1
    baud: Annotated[int, whole(4800, 230400, allowed=BAUDS)] = 115200
    parity: Literal["none", "even", "odd"] = "none"
    stop_bits: Annotated[int, whole(1, 2)] = 1
    counts_per_turn: Annotated[int, whole(20, 10_000_000, meaning=" of the position register in one turn of the motor")]
    in_position: Annotated[int, whole(0, 1000, meaning=" counts off its target at which a drive may settle")] = 0
    serial: Annotated[str, StringConstraints(max_length=40)] = ""
    late: Late = 0.001
    registers: RegistersConfig

    @property
    def counted(self) -> tuple[int, int]:
        return self.counts_per_turn, 1

    @property
    def untold_serial(self) -> str | None:
        return (self.serial or UNTOLD) if self.registers.serial is None else None

    def wire(self) -> dict[str, object]:
        return {"make": self.driver} | self.model_dump(mode="json", include={"unit", "counts_per_turn", "registers"})

    @model_validator(mode="after")
    def _countable(self) -> Self:
        low, high = self.travel
        most = COUNTS if min(self.registers.position.words, self.registers.target.words) == 2 else 2**15 - 1
        if (counts := max(-low, high) * self.counts_per_turn / self.lead) > most:
            raise ValueError(
                f"travel would be {counts:.3g} counts with this lead and counts_per_turn; the drive's registers count "
                f"to {most}. Use two words, or fewer counts_per_turn"
            )
        return self


def _connect(name: str, config: ModbusRailConfig, around: Surroundings) -> ModbusRail:
    from drivers.rail.modbus.rail import ModbusRail

    return ModbusRail(name, config, clock=around.clock, control=not around.look)


MODBUS: AnyMake = Make(
    "rail", "modbus", ModbusRailConfig, _connect, frozenset(("lead", "counts_per_turn", "registers")),
    simulated=with_endpoint("url"),
)  # fmt: skip
