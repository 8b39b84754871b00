"""Tells whether a Modbus drive has arrived at its target, and names the reason when it never will."""

from __future__ import annotations

from drivers.clock import Clock
from drivers.errors import Aborted, DeviceFault
from drivers.quantities import shown
from drivers.rail.axis import Samples
from drivers.rail.modbus.drive import ModbusDrive
from drivers.rail.modbus.zero import ZERO_M, DriveZero
from drivers.rail.motion import patience
from drivers.rail.tmcl.arrival import STANDSTILL_S


class DriveArrival:
    """Watches one positioning to `target` counts, appending readings to `samples`; it may settle `near` counts off it.

    `issued` is the count of stops it was commanded under. `zero` is asked whether the count still holds, and told when
    it does not; None where it does not matter. Called again and again: True at the target; raises `Aborted` after a
    stop and `DeviceFault` for rail.reset, rail.alarm, rail.limit_switch, rail.missed_target, rail.astray and
    rail.stalled.
    """

    def __init__(
        self,
        drive: ModbusDrive,
        clock: Clock,
        *,
        target: int,
        near: int,
        issued: int,
        samples: Samples,
        zero: DriveZero | None,
    ) -> None:
        self._drive = drive
        self._target = target
        self._near = near
        self._issued = issued
        self._samples = samples
        self._zero = zero
        self._standstill = patience(clock, STANDSTILL_S)
        self._begun: float | None = None
        self._last: float | None = None
        self._moved = clock.now()

    def __call__(self) -> bool:
        """Read the position once and judge it."""
        drive = self._drive
        stamp, position, round_trip = drive.position()
        self._samples.append((stamp, position, round_trip))
        if drive.link.stops != self._issued:
            raise Aborted(f"{drive.name}: stopped at {shown(position, 'm')} before its target")
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
