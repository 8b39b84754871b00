"""Whether the count still has its zero where the reference switch is: the carriage creeps over the switch's edge."""

from __future__ import annotations

from collections.abc import Callable

from drivers.errors import DeviceFault, shown

LOST_M = 0.05e-3
"""By so much the switch's edge may lie beside 0: more is steps that were lost."""
AHEAD_M = 0.2e-3
"""So far before and behind 0 the carriage creeps."""
CREEP = 0.5e-3
"""Speed over the edge, m/s."""
SURE_M = 0.5 * LOST_M
"""Between two readings the edge is known to no more than the way between them: over a longer one the carriage creeps
once more, at half the speed."""
MOST_CREEPS = 3
LONGEST_S = (2**MOST_CREEPS - 1) * 2.0 * AHEAD_M / CREEP
"""What all the creeping may take."""

Arrived = Callable[[], bool]


class ZeroCheck:
    """Called again and again until it returns True: to `AHEAD_M` at `speed` m/s, over the edge, and to 0.

    `begin(position, speed)` sends the carriage, in m and m/s, and gives what asks whether it has arrived; `position`
    reads the count in m, `switch` the reference switch, on below 0. Raises `DeviceFault` (rail.lost_steps) after
    `forget`, which ends the trust in the zero, and what `begin` and its arrivals raise.
    """

    def __init__(
        self,
        name: str,
        begin: Callable[[float, float], Arrived],
        position: Callable[[], float],
        switch: Callable[[], bool],
        forget: Callable[[], None],
        speed: float,
    ) -> None:
        self._name = name
        self._begin, self._position, self._switch, self._forget = begin, position, switch, forget
        self._speed = speed
        self._arrived = begin(AHEAD_M, speed)
        self._stage = 0
        self._creeps = 0
        self._off_at = AHEAD_M
        """Count when the switch was off last, and when it was on first."""
        self._on_at = -AHEAD_M

    def __call__(self) -> bool:
        """Read, judge and go on."""
        if self._stage == 0:
            self._approach()
        elif self._stage == 1:
            self._creep()
        else:
            return self._arrived()
        return False

    def _approach(self) -> None:
        try:
            if not self._arrived():
                return
        except DeviceFault as fault:
            if fault.code != "rail.limit_switch":
                raise
            raise self._lost(f"a limit switch is hit on the way to {shown(AHEAD_M, 'm')}") from fault
        if self._switch():
            raise self._lost(f"its reference switch is on at {shown(AHEAD_M, 'm')} already")
        self._stage, self._arrived = 1, self._begin(-AHEAD_M, CREEP * 0.5**self._creeps)
        self._off_at, self._on_at = AHEAD_M, -AHEAD_M

    def _creep(self) -> None:
        before, on = self._position(), self._switch()
        if not on:
            self._off_at = before
            if self._arrived():
                raise self._lost(f"its reference switch is still off at {shown(-AHEAD_M, 'm')}")
            return
        self._on_at = max(self._on_at, self._position())
        if self._on_at > LOST_M or self._off_at < -LOST_M:
            raise self._lost(
                f"its reference switch went on between {shown(self._off_at, 'm')} and {shown(self._on_at, 'm')} by its "
                "count"
            )
        if not self._arrived():
            return
        if self._off_at - self._on_at > SURE_M and self._creeps + 1 < MOST_CREEPS:
            # Readings came too late to tell.
            self._creeps += 1
            self._stage, self._arrived = 0, self._begin(AHEAD_M, self._speed)
        elif self._off_at + self._on_at > 2 * LOST_M or self._off_at + self._on_at < -2 * LOST_M:
            raise self._lost(f"its reference switch went on about {shown(0.5 * (self._off_at + self._on_at), 'm')}")
        else:
            self._stage, self._arrived = 2, self._begin(0.0, self._speed)

    def _lost(self, what: str) -> DeviceFault:
        self._forget()
        return DeviceFault(
            self._name,
            "rail.lost_steps",
            f"has lost steps since it was homed: {what} (allowed 0 ± {shown(LOST_M, 'm')}). What it has measured "
            "meanwhile is of no use",
            recoverable=True,
            hint="Home the rail and sweep again. If it comes back: see whether the carriage jams or its cable pulls, "
            "raise the motor's current, lower rail.acceleration.",
        )
