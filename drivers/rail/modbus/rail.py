"""The rail: a linear axis on a stepper or servo drive that speaks Modbus RTU, its registers as its manual has them.

Positions in m from the reference switch. Limits are checked before anything is sent; what is written is read back.
"""

from collections.abc import Callable

from drivers.clock import Clock
from drivers.errors import UNTOLD, ConfigError, LimitError, shown
from drivers.interfaces import Identity, RailState, Reading
from drivers.rail.axis import RailAxis, Samples
from drivers.rail.modbus.drive import DriveArrival, DriveZero, ModbusDrive, Rate
from drivers.rail.modbus.link import ModbusLink
from drivers.rail.modbus.make import ModbusRailConfig, NumberConfig

ROUNDING = 0.01
"""By what share a speed may be rounded to the drive's unit; an acceleration by five times that."""
_VELOCITY_S = 0.02
_SEARCH_S = 300.0
"""A drive searches at a speed of its own, which is not known here: sooner only its readings end the search."""


class ModbusRail(RailAxis):
    """The drive that `record` describes: where it is, its registers, and the axis that it moves.

    With `control=False` it is only looked at; see `RailAxis`. Raises `NotConnectedError` or `DeadlineError` when no
    drive answers, `ConfigError` on impossible parameters, `ModbusRefused` for a register that it does not have.
    """

    def __init__(self, name: str, record: ModbusRailConfig, *, clock: Clock, control: bool = True) -> None:
        super().__init__(
            name, clock, travel=record.travel, max_speed=record.max_speed, acceleration=record.acceleration,
            counts=record.counts_per_turn / record.lead, control=control,
        )  # fmt: skip
        self.registers = record.registers
        self._in_position = record.in_position
        self._serial = record.serial
        self._link: ModbusLink = ModbusLink(
            name, record.url, unit=record.unit, baud=record.baud, parity=record.parity, stop_bits=record.stop_bits,
            stop_action=record.registers.stop, clock=clock, statistics=self.statistics,
        )  # fmt: skip
        try:
            self._drive = ModbusDrive(self._link, record)
            self._check_ramp()
            self._drive.position()
            self._zero = DriveZero(self._drive, clock)
            if control:
                self._set_up()
        except BaseException:
            self._link.close()
            raise

    def identity(self) -> Identity:
        """The serial number from its register, if the map has one, else that of the configuration."""
        number = self.registers.serial
        self._drive.position()
        told = self._serial or UNTOLD if number is None else str(self._drive.read(number, signed=False))
        return Identity("Modbus RTU drive", told, UNTOLD, self._link.url)

    def ping(self) -> float:
        """Read the position once; returns the round trip in wall seconds."""
        return self._clock.wall(self._drive.position()[2])

    def examine(self, seconds: float) -> list[Reading]:
        """Whether the drive reports a fault, and its alarm's number."""
        flag = self.registers.fault
        if flag is None:
            return []
        return [
            Reading(
                "fault", float(self._drive.says(flag)), "", most=0.0,
                remedy=f"Alarm {self._drive.alarm}: see the drive's manual, clear it there, then home the rail.",
            )
        ]  # fmt: skip

    def state(self) -> RailState:
        """Read position, velocity, switches and whether it is homed now.

        The velocity is that between two readings while the drive says that it moves. Raises `DeviceFault` (rail.reset),
        once, when the drive has lost the zero that it had.
        """
        drive, registers = self._drive, self.registers
        stamp, position, _ = drive.position()
        velocity, moving = 0.0, drive.says(registers.moving)
        if moving:
            self._clock.sleep(_VELOCITY_S)
            later, there, _ = drive.position()
            velocity = (there - position) / (later - stamp)
            stamp, position = later, there
        homed = not self._homing and self._zero.held()
        return RailState(
            stamp=stamp, position=position, velocity=velocity, homed=homed, homed_here=homed and self._zero.found_here,
            moving=moving or self._homing, left_switch=drive.says(registers.left_switch),
            right_switch=drive.says(registers.right_switch),
        )  # fmt: skip

    def _position(self) -> float:
        return self._drive.position()[1]

    def _followed(self) -> tuple[float, bool, bool, Callable[[], bool]]:
        says, registers = self._drive.says, self.registers
        return self._position(), says(registers.left_switch), says(registers.right_switch), lambda: False

    def _require_zero(self) -> None:
        self._zero.require()

    def _begin_homing(self, issued: int) -> float:
        self._set_up()
        self._zero.search(issued=issued)
        return _SEARCH_S

    def _home_found(self, issued: int) -> bool:
        found = self._zero.found()
        self._homing = not found
        return found

    def _send(self, position: float, speed: float, issued: int) -> None:
        self._drive.set_rate(self.registers.speed, speed, issued)
        self._drive.set(self.registers.target, round(position * self._counts), issued)
        self._link.do(self.registers.start, issued=issued, moves=True)

    def _arrival(self, position: float, issued: int, samples: Samples, *, homed: bool = True) -> DriveArrival:
        return DriveArrival(
            self._drive, self._clock, target=round(position * self._counts), near=self._in_position, issued=issued,
            samples=samples, zero=self._zero if homed else None,
        )  # fmt: skip

    def _at_start(self) -> float:
        return super()._at_start() + self._in_position / self._counts

    def _checked_speed(self, what: str, speed: float) -> float:
        speed = super()._checked_speed(what, speed)
        rate = self.registers.speed
        kept = self._drive.kept(rate, speed)
        if abs(kept - speed) > ROUNDING * speed:
            raise LimitError(
                self.name,
                f"{what} {shown(speed, 'm/s')} would become {shown(kept, 'm/s')} in the drive's unit ({rate.unit}), "
                f"more than {ROUNDING:.0%} off; nothing was sent. Choose a multiple of "
                f"{shown(self._drive.least(rate), 'm/s')}",
            )
        return speed

    def _set_up(self) -> None:
        """Tell the drive what it forgets when it is reset."""
        for entry in self.registers.setup:
            self._drive.set(NumberConfig(address=entry.address, words=1), entry.value)
        for rate in self._ramps:
            self._drive.set_rate(rate, self._acceleration)

    @property
    def _ramps(self) -> list[Rate]:
        return [rate for rate in (self.registers.acceleration, self.registers.deceleration) if rate is not None]

    def _check_ramp(self) -> None:
        for rate in self._ramps:
            kept = self._drive.kept(rate, self._acceleration)
            if abs(kept - self._acceleration) > 5 * ROUNDING * self._acceleration:
                raise ConfigError(
                    f"{self.name}: the acceleration {shown(self._acceleration, 'm/s^2')} would become "
                    f"{shown(kept, 'm/s^2')} in the drive's unit ({rate.unit}), more than {5 * ROUNDING:.0%} off; "
                    "write another rail.acceleration"
                )
