"""Whether the carriage goes where it is sent, seen by its count and its limit switches while it moves.

For motions that no zero bounds: the search for the reference switch, and a nudge.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.clock import Clock
from drivers.errors import DeviceFault
from drivers.quantities import shown
from drivers.rail.motion import patience

MARGIN_M = 0.010
"""So much farther than the travel a search may go: limit switches and ends lie beyond the travel."""
STANDSTILL_S = 1.0
"""A search in which the count stands for this long has a motor that does not follow; drives pause as they turn back."""
BEGINS_S = 2.0
"""The same before the first motion."""
SIDES = ("left", "right")


class CarriageWatch:
    """Judges readings of one motion of the rail `name`, in their order; without `length` only its switches.

    `length` is the travel in m. Each call takes the position in m, the left and the right limit switch, and what asks
    whether a stall was detected. Raises `DeviceFault`: rail.switches when the switch of the other side trips,
    rail.no_reference when it went farther than the travel and `MARGIN_M`, rail.stalled when it does not move.
    """

    def __init__(self, name: str, clock: Clock, length: float | None) -> None:
        self._name = name
        self._clock = clock
        self._length = length
        self._last: float | None = None
        self._moved, self._began = clock.now(), False
        self._low = self._high = 0.0
        self._side: int | None = None
        self._off = [False, False]
        """Of each switch: it was seen off since the carriage went this way."""

    def __call__(self, position: float, left: bool, right: bool, stalled: Callable[[], bool]) -> None:
        """Judge one reading."""
        last, self._last = self._last, position
        now = self._clock.now()
        if last is None or (self._length is not None and abs(position - last) > self._length):
            # The first reading, or the count was set anew.
            self._low = self._high = position
            return
        if position == last:
            self._require_motion(now, position, left, right, stalled)
            return
        self._moved, self._began = now, True
        side = int(position > last)
        if side != self._side:
            self._side, self._off = side, [False, False]
        other = 1 - side
        if (left, right)[other] and self._off[other]:
            raise DeviceFault(
                self._name,
                "rail.switches",
                f"the {SIDES[other]} limit switch tripped at {shown(position, 'm')} while the carriage was sent "
                f"{SIDES[side]}: the limit switches are exchanged, or the motor turns the other way",
                recoverable=False,
                hint="See which way the carriage goes. Swap the wires of the two limit switches, or turn rail.reversed "
                "round; then run `cell commission`.",
            )
        self._off = [off or not on for off, on in zip(self._off, (left, right), strict=True)]
        self._low, self._high = min(self._low, position), max(self._high, position)
        if self._length is not None and self._high - self._low > self._length + MARGIN_M:
            raise DeviceFault(
                self._name,
                "rail.no_reference",
                f"has searched its reference switch over {shown(self._high - self._low, 'm')} and not found it "
                f"(travel {shown(self._length, 'm')}, allowed {shown(self._length + MARGIN_M, 'm')}); "
                f"{_shown(left, right)}",
                recoverable=False,
                hint="Press each switch by hand and see what `cell jog` shows; check rail.reference_mode, rail.lead.",
            )

    def _require_motion(
        self, now: float, position: float, left: bool, right: bool, stalled: Callable[[], bool]
    ) -> None:
        if self._length is None:
            return
        detected = stalled()
        if detected or now - self._moved > patience(self._clock, STANDSTILL_S if self._began else BEGINS_S):
            raise DeviceFault(
                self._name,
                "rail.stalled",
                f"the motor does not move in the search for the reference switch, at {shown(position, 'm')}"
                f"{' (stall detected)' if detected else ''}; {_shown(left, right)}",
                recoverable=False,
                hint="Look whether the carriage stands at an end: then its switches are exchanged or the motor turns "
                "the other way. Else see its current and its coupling.",
            )


def _shown(left: bool, right: bool) -> str:
    on = [side for side, state in zip(SIDES, (left, right), strict=True) if state]
    return f"the {' and the '.join(on)} limit switch shows" if on else "no limit switch shows"
