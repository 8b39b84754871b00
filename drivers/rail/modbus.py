"""The rail: a linear axis on a stepper or servo drive that speaks Modbus RTU, its registers as its manual has them.

Positions in m from the reference switch. Limits are checked before anything is sent; what is written is read back.
"""

from __future__ import annotations

from drivers.clock import Clock
from drivers.errors import Aborted, ConfigError, DeviceFault, InterlockError, LimitError
from drivers.interfaces import Identity, RailState, Reading
from drivers.quantities import UNTOLD, shown
from drivers.rail.axis import RailAxis, Samples
from drivers.rail.modbus_link import ModbusLink
from drivers.rail.motion import patience
from drivers.rail.registers import Flag, Number, Rate, RegisterMap

STANDSTILL_S = 0.5
"""A motor that has not moved for this long before its target has stalled."""
BEGINS_S = 1.0
"""So long a drive may take to begin its search, or to say that it has lost the zero that it had."""
ZERO_M = 1e-3
"""How far from 0 a drive may say that it stands when its search has ended."""
ROUNDING = 0.01
"""By what share a speed may be rounded to the drive's unit; an acceleration by five times that."""
_VELOCITY_S = 0.02


class ModbusRail(RailAxis):
    """A drive behind the serial port `url`, with number `unit`; its registers are those of `registers`.

    `lead` in m and `counts_per_turn` as the drive counts positions; `travel` (low, high) in m, `max_speed` in m/s,
    `acceleration` in m/s². A drive may settle `in_position` counts off its target. `serial` is what the plate says, for
    a drive that does not tell.

    Raises `NotConnectedError` or `DeadlineError` when no drive answers, `ConfigError` on impossible parameters,
    `ModbusRefused` for a register that it does not have.
    """

    def __init__(
        self,
        name: str,
        url: str,
        registers: RegisterMap,
        *,
        lead: float,
        counts_per_turn: int,
        travel: tuple[float, float],
        max_speed: float,
        acceleration: float,
        clock: Clock,
        unit: int = 1,
        baud: int = 115200,
        parity: str = "none",
        stop_bits: int = 1,
        in_position: int = 0,
        serial: str = "",
        control: bool = True,
    ) -> None:
        if not lead > 0 or not counts_per_turn > 0:
            raise ConfigError(
                f"{name}: lead {lead} m and counts per turn {counts_per_turn} must be greater than 0. Correct them in "
                "the configuration"
            )
        super().__init__(
            name,
            clock,
            travel=travel,
            max_speed=max_speed,
            acceleration=acceleration,
            counts=counts_per_turn / lead,
            control=control,
        )
        self.registers = registers
        self._lead = lead
        self._counts_per_turn = counts_per_turn
        self._in_position = in_position
        self._serial = serial
        self._seen_homed = False
        self._found_here = False
        self._searching_from: float | None = None
        self._check_ramp()
        self._link: ModbusLink = ModbusLink(
            name,
            url,
            unit=unit,
            baud=baud,
            parity=parity,
            stop_bits=stop_bits,
            stop_action=registers.stop,
            clock=clock,
            statistics=self.statistics,
        )
        try:
            self._read(registers.position)
            self._seen_homed = self._flag(registers.homed)
            if control:
                self._set_up()
        except BaseException:
            self._link.close()
            raise

    def identity(self) -> Identity:
        """The serial number from its register, if the map has one, else that of the configuration."""
        number = self.registers.serial
        serial = self._serial or UNTOLD
        if number is not None:
            serial = str(number.decode(self._link.read(number.address, number.words, input=number.input), signed=False))
        else:
            self._read(self.registers.position)
        return Identity("Modbus RTU drive", serial, UNTOLD, self._link.url)

    def ping(self) -> float:
        """Read the position once; returns the round trip in wall seconds."""
        return self._clock.wall(self._stamped()[2])

    def examine(self, seconds: float) -> list[Reading]:
        """Whether the drive reports a fault, and its alarm's number."""
        flag = self.registers.fault
        if flag is None:
            return []
        return [
            Reading(
                "fault", float(self._flag(flag)), "", most=0.0,
                remedy=f"Alarm {self._alarm()}: see the drive's manual, clear it there, then home the rail.",
            )
        ]  # fmt: skip

    def state(self) -> RailState:
        """Read position, velocity, switches and whether it is homed now.

        The velocity is that between two readings while the drive says that it moves. Raises `DeviceFault` (rail.reset),
        once, when the drive has lost the zero that it had.
        """
        stamp, position, _ = self._stamped()
        velocity, moving = 0.0, self._flag(self.registers.moving)
        if moving:
            self._clock.sleep(_VELOCITY_S)
            later, there, _ = self._stamped()
            velocity = (there - position) / (later - stamp)
            stamp, position = later, there
        homed = not self._homing and self._homed("since its last motion")
        left, right = self.registers.left_switch, self.registers.right_switch
        return RailState(
            stamp=stamp,
            position=position,
            velocity=velocity,
            homed=homed,
            homed_here=homed and self._found_here,
            moving=moving or self._homing,
            left_switch=left is not None and self._flag(left),
            right_switch=right is not None and self._flag(right),
        )

    # --- the zero ---

    def _homed(self, when: str) -> bool:
        """Whether the drive says that it is homed; `DeviceFault` (rail.reset), once, when it did before."""
        homed = self._flag(self.registers.homed)
        lost, self._seen_homed = self._seen_homed and not homed, homed
        if not homed:
            self._found_here = False
        if lost:
            raise DeviceFault(
                self.name,
                "rail.reset",
                f"the drive has lost its zero {when}: it was reset or without power, or another program set it up",
                recoverable=True,
                hint="Home the rail again; check the drive's supply.",
            )
        return homed

    def _require_zero(self) -> None:
        if not self._homed("since its last motion"):
            raise InterlockError(self.name, "is not homed, so positions mean nothing yet. Call home() first")

    def _begin_homing(self, issued: int) -> None:
        self._found_here = False
        self._set_up()
        self._searching_from = self._clock.now() if self._flag(self.registers.homed) else None
        self._link.do(self.registers.home, issued=issued, moves=True)
        self._seen_homed = False

    def _home_found(self, issued: int) -> bool:
        registers = self.registers
        homed, moving = self._flag(registers.homed), self._flag(registers.moving)
        if self._link.stops != issued:
            raise Aborted(f"{self.name}: stopped while searching the reference switch")
        if self._searching_from is not None:
            # It was homed before: until it moves, or says that it is not any more, that is no news.
            if moving or not homed:
                self._searching_from = None
            elif self._clock.now() - self._searching_from > patience(self._clock, BEGINS_S):
                raise self._fault(
                    "rail.not_begun",
                    f"the drive has not begun to search its reference switch within {BEGINS_S:g} s",
                    "Check rail.registers.home, and that the drive is enabled.",
                )
            return False
        if registers.fault is not None and self._flag(registers.fault):
            raise self._alarmed("while it searched its reference switch")
        if moving or not homed:
            return False
        if abs(here := self._position()) > ZERO_M:
            raise self._fault(
                "rail.setting",
                f"the drive has ended its search and counts {shown(here, 'm')} there (allowed ±{shown(ZERO_M, 'm')})",
                "Set its home offset to 0 and see that its position register starts there.",
            )
        self._seen_homed = self._found_here = True
        self._homing = False
        return True

    # --- motions ---

    def _position(self) -> float:
        return self._stamped()[1]

    def _at_start(self) -> float:
        return super()._at_start() + self._in_position / self._counts

    def _checked_speed(self, what: str, speed: float) -> float:
        speed = super()._checked_speed(what, speed)
        rate = self.registers.speed
        kept = self._lead * rate.decode(rate.encode(speed / self._lead, self._counts_per_turn), self._counts_per_turn)
        if abs(kept - speed) > ROUNDING * speed:
            raise LimitError(
                self.name,
                f"{what} {shown(speed, 'm/s')} would become {shown(kept, 'm/s')} in the drive's unit ({rate.unit}), "
                f"more than {ROUNDING:.0%} off; nothing was sent. Choose a multiple of "
                f"{shown(self._lead * rate.decode(1, self._counts_per_turn), 'm/s')}",
            )
        return speed

    def _send(self, position: float, speed: float, issued: int) -> None:
        registers = self.registers
        self._set(registers.speed.number, self._coded(registers.speed, speed), issued)
        self._set(registers.target, round(position * self._counts), issued)
        self._link.do(registers.start, issued=issued, moves=True)

    def _arrival(self, position: float, issued: int, samples: Samples) -> _Arrival:
        return _Arrival(self, round(position * self._counts), issued, samples)

    def _set_up(self) -> None:
        """Tell the drive what it forgets when it is reset."""
        registers = self.registers
        for address, value in registers.setup:
            self._set(Number(address), value)
        for rate in (registers.acceleration, registers.deceleration):
            if rate is not None:
                self._set(rate.number, self._coded(rate, self._acceleration))

    def _check_ramp(self) -> None:
        for rate in (self.registers.acceleration, self.registers.deceleration):
            if rate is None:
                continue
            kept = self._lead * rate.decode(self._coded(rate, self._acceleration), self._counts_per_turn)
            if abs(kept - self._acceleration) > 5 * ROUNDING * self._acceleration:
                raise ConfigError(
                    f"{self.name}: the acceleration {shown(self._acceleration, 'm/s^2')} would become "
                    f"{shown(kept, 'm/s^2')} in the drive's unit ({rate.unit}), more than {5 * ROUNDING:.0%} off; "
                    "write another rail.acceleration"
                )

    # --- registers ---

    def _coded(self, rate: Rate, value: float) -> int:
        return rate.encode(value / self._lead, self._counts_per_turn)

    def _read(self, number: Number) -> int:
        return number.decode(self._link.read(number.address, number.words, input=number.input))

    def _stamped(self) -> tuple[float, float, float]:
        """Host time in s, position in m, round trip in s of one reading."""
        number = self.registers.position
        words, stamp, round_trip = self._link.read_stamped(number.address, number.words, input=number.input)
        return stamp, number.decode(words) / self._counts, round_trip

    def _flag(self, flag: Flag) -> bool:
        return flag.decode(self._link.read(flag.address, 1, input=flag.input)[0])

    def _set(self, number: Number, value: int, issued: int | None = None) -> None:
        """Write a number and read it back; `DeviceFault` (rail.setting) when the drive has another."""
        try:
            words = number.encode(value)
        except ValueError as error:
            raise LimitError(
                self.name,
                f"{error} at register {number.address:#06x}; nothing was sent. Choose a smaller way, speed or "
                "acceleration",
            ) from error
        self._link.write(number.address, words, issued=issued)
        found = self._link.read(number.address, number.words)
        if found != words:
            raise self._fault(
                "rail.setting",
                f"the drive keeps {number.decode(found)} in register {number.address:#06x} instead of {value}",
                "See whether another program sets the drive up, and whether the value is in its range (rail.registers, "
                "rail.acceleration, rail.max_speed).",
                recoverable=False,
            )

    def _alarm(self) -> str:
        number = self.registers.alarm
        return "of unknown number" if number is None else f"{self._read(number) & 0xFFFF:#06x}"

    def _alarmed(self, when: str) -> DeviceFault:
        self._found_here = False
        return self._fault(
            "rail.alarm",
            f"the drive reports a fault {when}, alarm {self._alarm()}",
            "Look the alarm up in the drive's manual, clear its cause and the alarm there, then home the rail.",
        )

    def _fault(self, code: str, message: str, hint: str, *, recoverable: bool = True) -> DeviceFault:
        return DeviceFault(self.name, code, message, recoverable=recoverable, hint=hint)


class _Arrival:
    """Watches one positioning of `rail` to `target` counts; see `RailAxis._arrival`.

    Raises `Aborted` after a stop and `DeviceFault` for rail.reset, rail.alarm, rail.limit_switch, rail.missed_target
    and rail.stalled.
    """

    def __init__(self, rail: ModbusRail, target: int, issued: int, samples: Samples) -> None:
        self._rail = rail
        self._target = target
        self._issued = issued
        self._samples = samples
        self._standstill = patience(rail._clock, STANDSTILL_S)
        self._last: float | None = None
        self._moved = rail._clock.now()

    def __call__(self) -> bool:
        """Read the position once and judge it."""
        rail = self._rail
        stamp, position, round_trip = rail._stamped()
        self._samples.append((stamp, position, round_trip))
        if rail._link.stops != self._issued:
            raise Aborted(f"{rail.name}: stopped at {shown(position, 'm')} before its target")
        there = abs(round(position * rail._counts) - self._target) <= rail._in_position
        if there and not rail._flag(rail.registers.moving):
            # A drive that was reset stands at its target, too, if that is 0.
            if not rail._homed("in its motion"):
                rail._require_zero()
            return True
        if position != self._last:
            self._last, self._moved = position, stamp
        elif stamp - self._moved > self._standstill and not rail._flag(rail.registers.moving):
            raise self._failure(position)
        return False

    def _failure(self, position: float) -> DeviceFault:
        rail, registers = self._rail, self._rail.registers
        rail._homed("in its motion")
        if registers.fault is not None and rail._flag(registers.fault):
            return rail._alarmed("in its motion")
        goal = self._target / rail._counts
        short = f"stands at {shown(position, 'm')}, its target is {shown(goal, 'm')}"
        side, switch = ("right", registers.right_switch) if goal > position else ("left", registers.left_switch)
        if switch is not None and rail._flag(switch):
            return rail._fault(
                "rail.limit_switch",
                f"{short}: the {side} limit switch is hit",
                "Home the rail again and check the configured travel.",
            )
        if rail._read(registers.target) != self._target:
            return rail._fault(
                "rail.missed_target",
                f"{short}: somebody else changed the drive's target",
                "See what else commands this drive.",
            )
        return rail._fault(
            "rail.stalled",
            f"{short}: the motor does not move",
            "See whether the carriage is blocked, the drive is enabled and rail.registers.start is right, then home "
            "again.",
        )
