"""Tells whether the rail has arrived at its target, and names the reason when it never will."""

from __future__ import annotations

from drivers.clock import Clock
from drivers.errors import Aborted, DeviceFault
from drivers.quantities import shown
from drivers.rail.axis import Samples
from drivers.rail.motion import patience
from drivers.rail.tmcl.codec import Axis
from drivers.rail.tmcl.link import TmclLink
from drivers.rail.tmcl.zero import ZeroMark

STANDSTILL_S = 0.5
"""A motor that has not moved for this long before its target has stalled."""
_NEAR = 1
"""Counts off its target at which a module may come to rest, without saying that it has reached it."""
_STALL_FLAG = 1
_DRIVER_FAULTS = {1: "driver too hot", 3: "short circuit in phase A", 4: "short circuit in phase B"}


class ArrivalWatch:
    """Watches one positioning to `target` (microsteps; `counts` microsteps per m), appending readings to `samples`.

    `issued` is the count of stops it was commanded under. `zero` is asked whether the count still holds, and told when
    it does not; None for a motion that needs none. Called again and again: True at the target, or at most one count off
    it at rest; raises `Aborted` after a stop, `DeviceFault` for rail.reset, rail.limit_switch, rail.missed_target and
    rail.stalled.
    """

    def __init__(
        self,
        link: TmclLink,
        clock: Clock,
        *,
        target: int,
        counts: float,
        issued: int,
        samples: Samples,
        zero: ZeroMark | None,
    ) -> None:
        self._link = link
        self._target = target
        self._counts = counts
        self._issued = issued
        self._samples = samples
        self._zero = zero
        self._standstill = patience(clock, STANDSTILL_S)
        self._last: int | None = None
        self._moved = clock.now()

    def __call__(self) -> bool:
        """Read the position once and judge it."""
        position, stamp, round_trip = self._link.get_stamped(Axis.POSITION)
        self._samples.append((stamp, position / self._counts, round_trip))
        if self._link.stops != self._issued:
            raise Aborted(f"{self._link.name}: stopped at {shown(position / self._counts, 'm')} before its target")
        near = abs(position - self._target) <= _NEAR
        if near and (self._link.get(Axis.POSITION_REACHED) or (position == self._last and not self._moving())):
            # A module that was reset stands at its target, too, if that is 0.
            self._require_zero()
            return True
        if position != self._last:
            self._last, self._moved = position, stamp
        elif stamp - self._moved > self._standstill and not self._moving():
            raise self._failure(position)
        return False

    def _moving(self) -> bool:
        return self._link.get(Axis.VELOCITY) != 0

    def _failure(self, position: int) -> DeviceFault:
        link = self._link
        self._require_zero()
        short = (
            f"stands at {shown(position / self._counts, 'm')}, its target is {shown(self._target / self._counts, 'm')}"
        )
        side, switch = ("right", Axis.RIGHT_SWITCH) if self._target > position else ("left", Axis.LEFT_SWITCH)
        if link.get(switch):
            self._forget_zero()
            return DeviceFault(
                link.name,
                "rail.limit_switch",
                f"{short}: the {side} limit switch is hit",
                recoverable=True,
                hint="Home the rail again and check the configured travel.",
            )
        if link.get(Axis.TARGET_POSITION) != self._target:
            return DeviceFault(
                link.name,
                "rail.missed_target",
                f"{short}: somebody else changed the module's target",
                recoverable=True,
                hint="See what else commands this module.",
            )
        self._forget_zero()
        flags = link.get(Axis.DRIVER_ERRORS)
        reasons = [text for bit, text in _DRIVER_FAULTS.items() if flags >> bit & 1]
        if link.get(Axis.EXTENDED_ERRORS) & _STALL_FLAG:
            reasons.append("stall detected")
        return DeviceFault(
            link.name,
            "rail.stalled",
            f"{short}: the motor does not move" + (f" ({', '.join(reasons)})" if reasons else ""),
            recoverable=True,
            hint="See whether the carriage is blocked and the motor has current, then home again.",
        )

    def _require_zero(self) -> None:
        if self._zero is not None:
            self._zero.require_still()

    def _forget_zero(self) -> None:
        if self._zero is not None:
            self._zero.forget()
