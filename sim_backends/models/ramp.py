"""Velocity ramps of a stepper controller as pieces of constant acceleration, exact at any time.

A ramp is a list of `Piece`s in time order; each is monotone in position, and the last one goes on for ever.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


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
        t, x = _change(pieces, t, x, v, 0.0, acceleration)
        v = 0.0
    t, x = _change(pieces, t, x, v, target, acceleration)
    return [*pieces, Piece(t, x, target, 0.0)]


def to_position(t: float, x: float, v: float, target: float, speed: float, acceleration: float) -> list[Piece]:
    """The fastest way from (`x`, `v`) to rest at `target` within `speed` > 0 and `acceleration` > 0.

    A start that cannot stop before `target` overshoots and comes back, as the controller does.
    """
    pieces: list[Piece] = []
    standstill = x + v * abs(v) / (2.0 * acceleration)
    direction = math.copysign(1.0, target - standstill)
    if direction * v < 0.0:
        t, x = _change(pieces, t, x, v, 0.0, acceleration)
        v = 0.0
    distance = (target - x) * direction
    start = v * direction
    peak = min(math.sqrt(max(0.0, acceleration * distance + 0.5 * start * start)), speed)
    t, x = _change(pieces, t, x, v, direction * peak, acceleration)
    cruise = (target - x) * direction - peak * peak / (2.0 * acceleration)
    if cruise > 0.0 and peak > 0.0:
        pieces.append(Piece(t, x, direction * peak, 0.0))
        t, x = t + cruise / peak, x + direction * cruise
    t, _ = _change(pieces, t, x, direction * peak, 0.0, acceleration)
    return pieces + rest(t, target)


def clip(pieces: list[Piece], limit: float, direction: int) -> tuple[list[Piece], float | None]:
    """Cut a ramp where it would pass `limit` while moving in `direction` (−1 or +1), and stand there.

    A ramp that is beyond the limit already cannot move further that way. Also returns the time of the cut, or None.
    """
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
