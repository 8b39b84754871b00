"""The rail on a Modbus RTU drive: its record in `cell.toml`, with the register map that the drive's manual gives."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import StringConstraints, model_validator

from drivers.common.addresses import Port
from drivers.common.units import whole
from drivers.errors import UNTOLD
from drivers.make import AnyMake, Late, Make, RailConfig, Surroundings, Table, with_endpoint

if TYPE_CHECKING:
    from drivers.rail.modbus.link import Action, Flag, Number, Rate, RegisterMap
    from drivers.rail.modbus.rail import ModbusRail

BAUDS = (4800, 9600, 19200, 38400, 57600, 115200, 230400)
COUNTS = 2**31 - 1

Address = Annotated[int, whole(0, 0xFFFF, meaning=": a register's address on the wire, from 0 (0x6002 may be written)")]
Word = Annotated[int, whole(0, 0xFFFF)]


class NumberConfig(Table):
    """A number in one register, or in two."""

    address: Address
    words: Annotated[int, whole(1, 2, meaning=" registers of 16 bits")] = 2
    input: bool = False


class SpeedConfig(NumberConfig):
    """A speed in the drive's unit."""

    words: Annotated[int, whole(1, 2)] = 1
    unit: Literal["counts/s", "rpm", "0.1 rpm", "1/240 rps"]


class AccelerationConfig(NumberConfig):
    """An acceleration in the drive's unit, or the time that it takes to 1000 turns a minute."""

    words: Annotated[int, whole(1, 2)] = 1
    unit: Literal["counts/s^2", "rpm/s", "1/6 rps/s", "ms to 1000 rpm"]


class FlagConfig(Table):
    """A bit, counted from 0, of a register of 16 bits; it says yes where it is `set`."""

    address: Address
    bit: Annotated[int, whole(0, 15)]
    set: bool = True
    input: bool = False


class ActionConfig(Table):
    """A command: `value` is written, and then, for drives that look for an edge, `then`."""

    address: Address
    value: Word
    then: Word | None = None


class SetupConfig(Table):
    """A register that has to hold a value, such as the mode of a path or the way of homing."""

    address: Address
    value: Word


class RegistersConfig(Table):
    """What stands where in the drive; names as in `drivers.rail.modbus.link`."""

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
        """See `RailConfig`."""
        return self.counts_per_turn, 1

    @property
    def untold_serial(self) -> str | None:
        """See `RailConfig`."""
        return (self.serial or UNTOLD) if self.registers.serial is None else None

    def wire(self) -> dict[str, object]:
        """See `DeviceConfig`."""
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


def register_map(config: RegistersConfig) -> RegisterMap:
    """The record as the driver takes it."""
    from drivers.rail.modbus.link import RegisterMap

    return RegisterMap(**dict(_parts(config)))


def _parts(config: RegistersConfig) -> Iterator[tuple[str, Any]]:
    from drivers.rail.modbus.link import Action, Flag, Number, Rate

    high_first = config.word_order == "high first"

    def made(entry: Any) -> Number | Rate | Flag | Action | None:
        match entry:
            case SpeedConfig() | AccelerationConfig():
                return Rate(Number(entry.address, entry.words, entry.input, high_first), entry.unit)
            case NumberConfig():
                return Number(entry.address, entry.words, entry.input, high_first)
            case FlagConfig():
                return Flag(entry.address, entry.bit, entry.set, entry.input)
            case ActionConfig():
                return Action(entry.address, entry.value, entry.then)
        return None

    for name in type(config).model_fields:
        if name == "setup":
            yield name, tuple((entry.address, entry.value) for entry in config.setup)
        elif name != "word_order":
            yield name, made(getattr(config, name))


def _connect(name: str, config: ModbusRailConfig, around: Surroundings) -> ModbusRail:
    from drivers.rail.modbus.rail import ModbusRail

    return ModbusRail(
        name,
        config.url,
        register_map(config.registers),
        lead=config.lead,
        counts_per_turn=config.counts_per_turn,
        travel=config.travel,
        max_speed=config.max_speed,
        acceleration=config.acceleration,
        clock=around.clock,
        unit=config.unit,
        baud=config.baud,
        parity=config.parity,
        stop_bits=config.stop_bits,
        in_position=config.in_position,
        serial=config.serial,
        control=not around.look,
    )


MODBUS: AnyMake = Make(
    "rail", "modbus", ModbusRailConfig, _connect, frozenset(("lead", "counts_per_turn", "registers")),
    simulated=with_endpoint("url"),
)  # fmt: skip
