"""A Modbus drive by its register map: positions, settings that are read back, its zero, arrivals and faults in words.

Its flag goes off when the drive loses its zero; that it stands says neither who homed it nor under which settings.
"""

from drivers.clock import Clock, timeout_of
from drivers.errors import DeviceFault, InterlockError, LimitError, shown
from drivers.rail.axis import Samples
from drivers.rail.modbus.link import ModbusLink
from drivers.rail.modbus.make import AccelerationConfig, FlagConfig, ModbusRailConfig, NumberConfig, SpeedConfig
from drivers.rail.motion import STANDSTILL_S

Rate = SpeedConfig | AccelerationConfig


class ModbusDrive:
    """The drive at the other end of `link`, as `record` describes it; `counts` of its position register to a metre."""

    def __init__(self, link: ModbusLink, record: ModbusRailConfig) -> None:
        self.link = link
        self.registers = record.registers
        self.name = link.name
        self.counts = record.counts_per_turn / record.lead
        self._lead = record.lead
        self._turn = record.counts_per_turn

    def _ordered(self, words: list[int]) -> list[int]:
        """Words as the drive has them of words with the high one first, or back."""
        return words if self.registers.word_order == "high first" else words[::-1]

    def position(self) -> tuple[float, float, float]:
        """Host time in s, position in m, round trip in s of one reading."""
        number = self.registers.position
        words, stamp, round_trip = self.link.read_stamped(number.address, number.words, input=number.input)
        return stamp, number.decode(self._ordered(words)) / self.counts, round_trip

    def says(self, flag: FlagConfig | None) -> bool:
        """What a flag says now; no for one that the drive does not have."""
        return flag is not None and flag.decode(self.link.read(flag.address, 1, input=flag.input)[0])

    def read(self, number: NumberConfig, *, signed: bool = True) -> int:
        """Read a number."""
        words = self.link.read(number.address, number.words, input=number.input)
        return number.decode(self._ordered(words), signed=signed)

    def set(self, number: NumberConfig, value: int, issued: int | None = None) -> None:
        """Write a number and read it back; `DeviceFault` (rail.setting) when the drive has another."""
        try:
            words = self._ordered(number.encode(value, signed=number is self.registers.target))
        except ValueError as error:
            raise LimitError(
                self.name,
                f"{error} at register {number.address:#06x}; nothing was sent. Choose a smaller way, speed or "
                "acceleration",
            ) from error
        self.link.write(number.address, words, issued=issued)
        found = self.link.read(number.address, number.words)
        if found != words:
            kept = number.decode(self._ordered(found))
            raise self.fault(
                "rail.setting",
                f"the drive keeps {kept} in register {number.address:#06x} instead of {value}",
                "See whether another program sets the drive up, and whether the value is in its range (rail.registers, "
                "rail.acceleration, rail.max_speed).",
                recoverable=False,
            )

    def set_rate(self, rate: Rate, value: float, issued: int | None = None) -> None:
        """Write a speed (m/s) or an acceleration (m/s²)."""
        self.set(rate, rate.units(value / self._lead, self._turn), issued)

    def kept(self, rate: Rate, value: float) -> float:
        """What a speed (m/s) or an acceleration (m/s²) would become in the drive's unit."""
        return self._lead * rate.turns(rate.units(value / self._lead, self._turn), self._turn)

    def least(self, rate: Rate) -> float:
        """What one of the drive's units is, in m/s or m/s²."""
        return self._lead * rate.turns(1, self._turn)

    @property
    def alarm(self) -> str:
        """The alarm's number, as manuals have it."""
        number = self.registers.alarm
        return "of unknown number" if number is None else f"{self.read(number) & 0xFFFF:#06x}"

    def alarmed(self, when: str) -> DeviceFault:
        """The fault of a drive that reports one."""
        return self.fault(
            "rail.alarm",
            f"the drive reports a fault {when}, alarm {self.alarm}",
            "Look the alarm up in the drive's manual, clear its cause and the alarm there, then home the rail.",
        )

    def fault(self, code: str, message: str, hint: str, *, recoverable: bool = True) -> DeviceFault:
        """A fault in the drive's name."""
        return DeviceFault(self.name, code, message, recoverable=recoverable, hint=hint)


BEGINS_S = 1.0
"""So long a drive may take to begin its search, or to say that it has lost the zero that it had."""
ZERO_M = 1e-3
"""How far from 0 a drive may say that it stands when its search has ended."""


class DriveZero:
    """The zero of `drive`. What happened to it while nobody watched is judged on connecting: with a fault, or at a
    limit switch, it is not trusted."""

    def __init__(self, drive: ModbusDrive, clock: Clock) -> None:
        registers = drive.registers
        self._drive = drive
        self._clock = clock
        self._seen = drive.says(registers.homed)
        self._distrusted = any(
            drive.says(flag) for flag in (registers.fault, registers.left_switch, registers.right_switch)
        )
        self._homed_since: float | None = None
        self.found_here = False
        """Whether this program saw the search end; what an earlier one found may be long ago."""

    def held(self, when: str = "since its last motion") -> bool:
        """Whether the drive, asked now, counts from a zero that a homing found. Raises `DeviceFault` (rail.reset),
        once, when it did before and does not any more."""
        homed = self._drive.says(self._drive.registers.homed)
        lost, self._seen = self._seen and not homed, homed
        if not homed:
            self.found_here = False
        if lost:
            raise self._drive.fault(
                "rail.reset",
                f"the drive has lost its zero {when}: it was reset or without power, or another program set it up",
                "Home the rail again; check the drive's supply.",
            )
        return homed and not self._distrusted

    def require(self, when: str = "since its last motion") -> None:
        """Raise unless `held`: `InterlockError` when it was never homed."""
        if not self.held(when):
            raise InterlockError(self._drive.name, "is not homed, so positions mean nothing yet. Call home() first")

    def forget(self) -> None:
        """The count can no longer be trusted by this program. Another one cannot be told."""
        self._distrusted, self.found_here = True, False

    def search(self, *, issued: int) -> None:
        """Begin the search for the reference switch."""
        self.forget()
        homed = self._drive.says(self._drive.registers.homed)
        self._homed_since = self._clock.now() if homed else None
        self._drive.link.do(self._drive.registers.home, issued=issued, moves=True)
        self._seen = False

    def found(self) -> bool:
        """Whether the search has ended at its zero. Raises `DeviceFault`: rail.not_begun when the drive does not begin,
        rail.alarm, and rail.setting when it counts from somewhere else."""
        drive, registers = self._drive, self._drive.registers
        homed, moving = drive.says(registers.homed), drive.says(registers.moving)
        if self._homed_since is not None:
            # It was homed before: until it moves, or says that it is not any more, that is no news.
            if moving or not homed:
                self._homed_since = None
            elif self._clock.now() - self._homed_since > timeout_of(self._clock, BEGINS_S):
                raise drive.fault(
                    "rail.not_begun",
                    f"the drive has not begun to search its reference switch within {BEGINS_S:g} s",
                    "Check rail.registers.home, and that the drive is enabled.",
                )
            return False
        if drive.says(registers.fault):
            raise drive.alarmed("while it searched its reference switch")
        if moving or not homed:
            return False
        if abs(here := drive.position()[1]) > ZERO_M:
            raise drive.fault(
                "rail.setting",
                f"the drive has ended its search and counts {shown(here, 'm')} there (allowed ±{shown(ZERO_M, 'm')})",
                "Set its home offset to 0 and see that its position register starts there.",
            )
        self._seen = self.found_here = True
        self._distrusted = False
        return True


class DriveArrival:
    """Watches one positioning to `target` counts, appending readings to `samples`; it may settle `near` counts off it.

    `issued` is the count of stops it was commanded under. `zero` is asked whether the count still holds, and told when
    it does not; None where it does not matter. Called again and again: True at the target; raises `Aborted` after a
    stop and `DeviceFault` for rail.reset, rail.alarm, rail.limit_switch, rail.missed_target, rail.astray and
    rail.stalled.
    """

    def __init__(
        self, drive: ModbusDrive, clock: Clock, *, target: int, near: int, issued: int, samples: Samples,
        zero: DriveZero | None,
    ) -> None:  # fmt: skip
        self._drive = drive
        self._target = target
        self._near = near
        self._issued = issued
        self._samples = samples
        self._zero = zero
        self._standstill = timeout_of(clock, STANDSTILL_S)
        self._begun: float | None = None
        self._last: float | None = None
        self._moved = clock.now()

    def __call__(self) -> bool:
        """Read the position once and judge it."""
        drive = self._drive
        stamp, position, round_trip = drive.position()
        self._samples.append((stamp, position, round_trip))
        if drive.link.stops.count != self._issued:
            return drive.link.stops.end(drive.name, position)
        there = abs(round(position * drive.counts) - self._target) <= self._near
        if there and not drive.says(drive.registers.moving):
            # A drive that was reset stands at its target, too, if that is 0.
            self._require_zero()
            return True
        if self._begun is None:
            self._begun = position
        if self._astray(position):
            raise self._failure(position)
        if position != self._last:
            self._last, self._moved = position, stamp
        elif stamp - self._moved > self._standstill and not drive.says(drive.registers.moving):
            raise self._failure(position)
        return False

    def _astray(self, position: float) -> bool:
        """Whether a reading is none of the way, beyond what a drive may overshoot."""
        low, high = sorted((self._begun or 0.0, self._target / self._drive.counts))
        slack = ZERO_M + self._near / self._drive.counts
        return not low - slack <= position <= high + slack

    def _failure(self, position: float) -> DeviceFault:
        drive, registers = self._drive, self._drive.registers
        self._require_zero()
        goal = self._target / drive.counts
        short = f"stands at {shown(position, 'm')}, its target is {shown(goal, 'm')}"
        if not drive.says(registers.fault) and drive.read(registers.target) != self._target:
            return drive.fault(
                "rail.missed_target",
                f"{short}: somebody else changed the drive's target",
                "See what else commands this drive.",
            )
        if self._zero is not None:
            self._zero.forget()
        if drive.says(registers.fault):
            return drive.alarmed("in its motion")
        if self._astray(position):
            return drive.fault(
                "rail.astray",
                f"says that it is at {shown(position, 'm')}, on its way from {shown(self._begun or 0.0, 'm')} to "
                f"{shown(goal, 'm')}",
                "See that rail.registers.word_order and the addresses of position and target are right, that it counts "
                "up the way it is sent up, and that nothing else moves it; then home again.",
            )
        side, switch = ("right", registers.right_switch) if goal > position else ("left", registers.left_switch)
        if drive.says(switch):
            return drive.fault(
                "rail.limit_switch",
                f"{short}: the {side} limit switch is hit",
                "Home the rail again and check the configured travel.",
            )
        return drive.fault(
            "rail.stalled",
            f"{short}: the motor does not move",
            "See whether the carriage is blocked, the drive is enabled and rail.registers.start is right, then home "
            "again.",
        )

    def _require_zero(self) -> None:
        if self._zero is not None:
            self._zero.require("in its motion")
