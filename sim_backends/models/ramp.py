"""Velocity ramps of a stepper controller as pieces of constant acceleration, and the lead screw that they turn.

A ramp is a list of `Piece`s in time order; each is monotone in position, and the last one goes on for ever.
"""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Screw:
    """Screw of `lead` m per turn; `scale_error` is relative, `periodic` (m) and `backlash` (m) are amplitude and width.
    The phase is that of the periodic error in rad."""

    lead: float = 0.002
    scale_error: float = 0.0
    periodic: float = 0.0
    phase: float = 0.0
    backlash: float = 0.0

    def travel(self, nut_turns: float) -> float:
        """Carriage displacement in m for the nut's position in turns."""
        periodic = self.periodic * (math.sin(2.0 * math.pi * nut_turns + self.phase) - math.sin(self.phase))
        return self.lead * (1.0 + self.scale_error) * nut_turns + periodic

    def nut(self, travel: float) -> float:
        """The nut's position in turns for a carriage displacement in m (inverse of `travel`)."""
        lead = self.lead * (1.0 + self.scale_error)
        turns = travel / lead
        for _ in range(20):
            turns += (travel - self.travel(turns)) / lead
        return turns

    def follow(self, nut_turns: float, motor_turns: float) -> float:
        """Where the nut is after the motor has moved monotonically to `motor_turns`, coming from `nut_turns`."""
        half = 0.5 * self.backlash / self.lead
        return min(max(nut_turns, motor_turns - half), motor_turns + half)

    def motor(self, travel: float, direction: int) -> float:
        """The motor's position in turns at which the carriage passes `travel` (m) while moving in `direction` (±1)."""
        return self.nut(travel) + direction * 0.5 * self.backlash / self.lead


@dataclass(frozen=True)
class Piece:
    """From time `t` (s) on: position `x`, velocity `v`, constant acceleration `a`, in any one unit of length."""

    t: float
    x: float
    v: float
    a: float

    def at(self, t: float) -> tuple[float, float]:
        """Position and velocity at time `t`."""
        dt = t - self.t
        return self.x + dt * (self.v + 0.5 * self.a * dt), self.v + self.a * dt


def rest(t: float, x: float) -> list[Piece]:
    """Standing still at `x` from `t` on."""
    return [Piece(t, x, 0.0, 0.0)]


def to_velocity(t: float, x: float, v: float, target: float, acceleration: float) -> list[Piece]:
    """Change from velocity `v` to `target` at `acceleration` > 0, then keep it."""
    pieces: list[Piece] = []
    if v * target < 0.0:
        t, x = _change(pieces, t, x, v=v, target=0.0, acceleration=acceleration)
        v = 0.0
    t, x = _change(pieces, t, x, v=v, target=target, acceleration=acceleration)
    return [*pieces, Piece(t, x, target, 0.0)]


@dataclass(frozen=True)
class Slopes:
    """How velocity changes in positioning: `up` and `down` per s², below `first_speed` `first_up` and `last_down`."""

    up: float
    down: float
    first_speed: float = 0.0
    first_up: float = 0.0
    last_down: float = 0.0

    def rise(self, low: float, high: float) -> float:
        """Way on which the speed goes up from `low` to `high`."""
        return _way(low, high, self.first_speed, self.first_up, self.up)

    def fall(self, speed: float) -> float:
        """Way from `speed` to rest."""
        return _way(0.0, speed, self.first_speed, self.last_down, self.down)


def to_position(t: float, x: float, v: float, target: float, speed: float, slopes: Slopes | float) -> list[Piece]:
    """The fastest way from (`x`, `v`) to rest at `target` within `speed` > 0 and `slopes`, one number for all of them.
    A start that cannot stop before `target` overshoots and comes back, as the controller does."""
    if not isinstance(slopes, Slopes):
        slopes = Slopes(slopes, slopes)
    pieces: list[Piece] = []
    standstill = x + math.copysign(slopes.fall(abs(v)), v)
    direction = math.copysign(1.0, target - standstill)
    if direction * v < 0.0:
        t, x = _brake(pieces, t, x, v=v, end=0.0, slopes=slopes)
        v = 0.0
    distance, start = (target - x) * direction, v * direction
    if start > speed:
        t, x = _brake(pieces, t, x, v=v, end=direction * speed, slopes=slopes)
        distance, start = (target - x) * direction, speed
    peak = _peak(distance, start, speed, slopes)
    for end in _corners(start, peak, slopes.first_speed):
        up = slopes.first_up if end <= slopes.first_speed else slopes.up
        t, x = _change(pieces, t, x, v=direction * start, target=direction * end, acceleration=up)
        start = end
    cruise = (target - x) * direction - slopes.fall(peak)
    if cruise > 0.0 and peak > 0.0:
        pieces.append(Piece(t, x, direction * peak, 0.0))
        t, x = t + cruise / peak, x + direction * cruise
    t, _ = _brake(pieces, t, x, v=direction * peak, end=0.0, slopes=slopes)
    return pieces + rest(t, target)


def _peak(distance: float, start: float, speed: float, slopes: Slopes) -> float:
    """The highest speed on a way of `distance` that begins at `start` and ends at rest; at most `speed`."""
    if slopes.rise(start, speed) + slopes.fall(speed) <= distance:
        return speed
    if not slopes.first_speed:
        top = 2.0 * slopes.up * slopes.down * distance + slopes.down * start * start
        return max(start, math.sqrt(max(0.0, top / (slopes.up + slopes.down))))
    low, high = start, speed
    for _ in range(200):
        middle = 0.5 * (low + high)
        if slopes.rise(start, middle) + slopes.fall(middle) <= distance:
            low = middle
        else:
            high = middle
    return low


def _way(low: float, high: float, bend: float, below: float, above: float) -> float:
    """Way between two speeds, with one slope below `bend` and another above."""
    way = 0.0
    if low < min(high, bend):
        way += (min(high, bend) ** 2 - low * low) / (2.0 * below)
    if high > max(low, bend):
        way += (high * high - max(low, bend) ** 2) / (2.0 * above)
    return way


def _corners(start: float, end: float, bend: float) -> list[float]:
    """Speeds at which a change from `start` to `end` ends a slope."""
    return [bend, end] if min(start, end) < bend < max(start, end) else [end]


def _brake(pieces: list[Piece], t: float, x: float, v: float, end: float, slopes: Slopes) -> tuple[float, float]:
    """Append the way from velocity `v` down to `end` of the same sign or 0; returns its end (time, position)."""
    for speed in _corners(abs(v), abs(end), slopes.first_speed):
        slope = slopes.down if abs(v) > slopes.first_speed else slopes.last_down
        goal = math.copysign(speed, v)
        t, x = _change(pieces, t, x, v=v, target=goal, acceleration=slope)
        v = goal
    return t, x


def clip(pieces: list[Piece], limit: float, direction: int) -> tuple[list[Piece], float | None]:
    """Cut a ramp where it would pass `limit` while moving in `direction` (−1 or +1), and stand there. A ramp that is
    beyond the limit already cannot move further that way. Also returns the time of the cut, or None."""
    for i, piece in enumerate(pieces):
        end = pieces[i + 1].t if i + 1 < len(pieces) else math.inf
        crossing = _crossing(piece, end, limit, direction)
        if crossing is not None:
            if crossing == piece.t:
                return pieces[:i] + rest(crossing, piece.x), crossing
            return pieces[: i + 1] + rest(crossing, limit), crossing
    return pieces, None


def _change(
    pieces: list[Piece], t: float, x: float, v: float, target: float, acceleration: float
) -> tuple[float, float]:
    """Append the piece that changes velocity `v` to `target`; returns its end (time, position)."""
    if v == target:
        return t, x
    a = math.copysign(acceleration, target - v)
    pieces.append(Piece(t, x, v, a))
    return t + (target - v) / a, x + (target * target - v * v) / (2.0 * a)


def _crossing(piece: Piece, end: float, limit: float, direction: int) -> float | None:
    """The time at which `piece` (until `end`) leaves `limit` behind in `direction`, or None."""
    moving = direction * (piece.v if piece.v != 0.0 else piece.a) > 0.0
    if not moving:
        return None
    gap = (limit - piece.x) * direction
    if gap < -1e-12 or (abs(gap) <= 1e-12 and end > piece.t):
        return piece.t
    v, a = piece.v * direction, piece.a * direction
    root = v * v + 2.0 * a * gap
    if root < 0.0:
        return None
    time = piece.t + 2.0 * gap / (v + math.sqrt(root))
    return time if time < end - 1e-12 else None
