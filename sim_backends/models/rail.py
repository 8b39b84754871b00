"""The scan head's rail: a stepper with its ramps, switches and screw, exact at any world time.

Motion is kept as a time line of constant-acceleration pieces in motor turns, so nothing has to be ticked and cameras
may ask for the recent past. The controller counts microsteps; only `carriage` knows where the carriage really is.
"""

import threading
from bisect import bisect_right
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from sim_backends.faults import EXCHANGED_SWITCHES, LOST_STEPS
from sim_backends.faults import RAIL_MODEL_FAULTS as FAULTS
from sim_backends.models import ramp
from sim_backends.models.ramp import Screw


@dataclass(frozen=True)
class RailParams:
    """Hardware of one rail. Lengths in m from where the home switch's edge is; the left and right switches and the
    mechanical ends lie beyond the usable travel. `repeatability` is the scatter (1 σ) of a switch edge per search."""

    screw: Screw = field(default_factory=Screw)
    steps_per_turn: int = 200
    travel: tuple[float, float] = (0.0, 0.100)
    switches: tuple[float, float] = (-0.002, 0.102)
    ends: tuple[float, float] = (-0.004, 0.104)
    repeatability: float = 0.0
    start: float = 0.037
    reversed: bool = False
    """A coil of the motor is connected the other way round: it turns backwards."""
    serial: int = 1
    firmware: tuple[int, int] = (1, 12)

    def around(self, travel: tuple[float, float]) -> Self:
        """The same for a usable `travel`, m: the home switch at 0, the others 2 mm and the ends 4 mm beyond both."""
        low, high = min(0.0, travel[0]), max(0.0, travel[1])
        return replace(self, travel=travel, switches=(low - 0.002, high + 0.002), ends=(low - 0.004, high + 0.004))


@dataclass(frozen=True)
class RailSettings:
    """What the controller's axis parameters set: pps and pps² (microsteps), switches, reference search."""

    max_velocity: int = 512_000
    max_acceleration: int = 2_000_000
    max_deceleration: int | None = None
    """Of positioning; None: the acceleration."""
    first_acceleration: int = 2_000_000
    last_deceleration: int = 2_000_000
    first_speed: int = 0
    """Below this speed (pps) positioning uses the two above instead; 0 switches that off."""
    microsteps: int = 8
    """Microsteps per full step as a power of two."""
    search_mode: int = 1
    """1 left switch; 2 right, then left switch; 3, 4 the same; 5 or 7 home switch in negative direction; 6 the same
    from the right switch."""
    search_speed: int = 256_000
    switch_speed: int = 51_200
    left_stop: bool = True
    right_stop: bool = True
    soft_stop: bool = False
    reverse_shaft: bool = False


__all__ = ["RailModel", "RailParams", "RailSettings"]

_LOST = 0.10
"""Share of the steps that a motor with `LOST_STEPS` loses on its way to the right, as the counter goes on."""
_KEEP = 30.0
_BACK_OFF = 0.0005


@dataclass(frozen=True)
class _Leg:
    """One piece of the time line with the nut's place at its start, the motor turn that the counter calls zero, and
    what it counts in a turn."""

    piece: ramp.Piece
    nut: float
    zero: float
    steps: float
    searching: bool


class RailModel:
    """One rail. All times are world seconds; commands must be given in time order; safe between threads."""

    def __init__(self, params: RailParams, rng: np.random.Generator) -> None:
        """A rail that was switched on at world time 0, standing still at `params.start` and not referenced."""
        self.params = params
        self.settings = RailSettings()
        self._rng = rng
        self._faults: set[str] = set()
        self._losing = False
        self._lock = threading.RLock()
        self._edge = 0.0
        self._switch_distance = 0
        self._stalled_at: float | None = None
        motor = params.screw.nut(params.start)
        self._zero = motor
        self._legs = [_Leg(ramp.Piece(0.0, motor, 0.0, 0.0), motor, motor, self._signed_steps(), False)]
        self._target = 0
        self._target_velocity = 0
        self._positioning = False

    def carriage(self, t: float) -> float:
        """True carriage displacement in m at world time `t` (at most 30 s ago)."""
        with self._lock:
            return self.params.screw.travel(self._nut(self._leg(t), t))

    def position(self, t: float) -> int:
        """Step counter in microsteps."""
        with self._lock:
            leg = self._leg(t)
            return round((leg.piece.at(max(t, leg.piece.t))[0] - leg.zero) * leg.steps)

    def velocity(self, t: float) -> int:
        """Present velocity in microsteps per second."""
        with self._lock:
            leg = self._leg(t)
            return round(leg.piece.at(max(t, leg.piece.t))[1] * leg.steps)

    def target(self) -> int:
        """Target of the last positioning in microsteps."""
        with self._lock:
            return self._target

    def target_velocity(self) -> int:
        """Velocity that is being aimed at in microsteps per second (in positioning: 0)."""
        with self._lock:
            return self._target_velocity

    def reached(self, t: float) -> bool:
        """True when the rail stands at its target."""
        with self._lock:
            return self.velocity(t) == 0 and self.position(t) == self._target and not self.searching(t)

    def left_switch(self, t: float) -> bool:
        """State of the input of the left limit switch."""
        return self._at_switch(t, 1 if EXCHANGED_SWITCHES in self._faults else 0)

    def right_switch(self, t: float) -> bool:
        """State of the input of the right limit switch."""
        return self._at_switch(t, 0 if EXCHANGED_SWITCHES in self._faults else 1)

    def home_switch(self, t: float) -> bool:
        """State of the home switch: active from its edge at 0 to the left end."""
        return self.carriage(t) <= self._edge + 1e-9

    def stalled(self, t: float) -> bool:
        """True when the motor was stopped by a mechanical end since the last `clear_stall`."""
        with self._lock:
            return self._stalled_at is not None and t >= self._stalled_at

    def clear_stall(self) -> None:
        """Forget a stall."""
        with self._lock:
            self._stalled_at = None

    def searching(self, t: float) -> bool:
        """True while a reference search is running."""
        with self._lock:
            return self._leg(t).searching

    def switch_distance(self) -> int:
        """Microsteps between the switches as found by the last search of both, else 0."""
        with self._lock:
            return self._switch_distance

    def fault(self, name: str, t: float) -> None:
        """Until `clear`: the wires of the limit switches are exchanged, or the motor loses a tenth of its steps on its
        way to the right. Raises ValueError for a name that is not in `FAULTS`."""
        if name not in FAULTS:
            raise ValueError(f"unknown rail fault {name!r}; known: {', '.join(FAULTS)}")
        self._have(t, self._faults | {name})

    def clear(self, t: float) -> None:
        """Take away both faults; steps that were lost stay lost."""
        self._have(t, set())

    def move_to(self, t: float, position: int) -> None:
        """Start positioning to `position` (microsteps)."""
        with self._lock:
            self._lose(t, position > self.position(t))
            x, v = self._begin(t)
            self._target, self._target_velocity, self._positioning = position, 0, True
            speed = self.settings.max_velocity / self._steps()
            goal = self._zero + position / self._signed_steps()
            if speed == 0.0:
                self._follow(ramp.to_velocity(t, x, v, 0.0, self._acceleration()))
            else:
                self._follow(ramp.to_position(t, x, v, target=goal, speed=speed, slopes=self._slopes()))

    def rotate(self, t: float, velocity: int) -> None:
        """Turn at `velocity` (microsteps per second, sign is direction) until told otherwise; 0 stops on the ramp."""
        with self._lock:
            self._lose(t, velocity > 0)
            x, v = self._begin(t)
            self._target_velocity, self._positioning = velocity, False
            self._follow(ramp.to_velocity(t, x, v, velocity / self._signed_steps(), self._acceleration()))

    def set_position(self, t: float, position: int) -> None:
        """Call the present place `position` (microsteps) and stop there."""
        with self._lock:
            x, _ = self._begin(t)
            self._zero = x - position / self._signed_steps()
            self._target, self._target_velocity, self._positioning = position, 0, False
            self._follow(ramp.rest(t, x))

    def reset(self, t: float) -> None:
        """The controller starts anew, as after a loss of power: it stops dead where it is and calls that place 0."""
        with self._lock:
            self.settings = RailSettings()
            self.set_position(t, 0)
            self._stalled_at = None

    def configure(self, t: float, settings: RailSettings) -> None:
        """Take new settings; a running positioning goes on under them, and the counter keeps its value."""
        with self._lock:
            old = self.settings
            if (settings.microsteps, settings.reverse_shaft) != (old.microsteps, old.reverse_shaft):
                position = self.position(t)
                self.settings = settings
                self.set_position(t, position)
                return
            self.settings = settings
            if self._positioning and self.velocity(t) != 0:
                self.move_to(t, self._target)

    def search(self, t: float) -> None:
        """Start a reference search: fast to the switch, back, slowly to its edge, and call that zero."""
        with self._lock:
            self._lose(t, False)
            x, v = self._begin(t)
            self._edge = float(self._rng.normal(0.0, self.params.repeatability)) if self.params.repeatability else 0.0
            self._target, self._target_velocity, self._positioning = 0, 0, False
            legs = ramp.to_velocity(t, x, v, 0.0, self._acceleration())
            if self.backwards:
                self._search_in_vain(legs, +1)
                return
            mode = self.settings.search_mode
            if EXCHANGED_SWITCHES in self._faults and mode not in (5, 7):
                self._search_in_vain(legs, -1 if mode == 1 else +1)
                return
            right = self._motor(self.params.switches[1], +1)
            if mode in (2, 3, 6):
                legs = self._run(legs, right, self.settings.search_speed)
            edge = self.params.switches[0] if mode <= 4 else 0.0
            zero = self._motor(edge, -1)
            if legs[-1].x > zero:
                legs = self._run(legs, zero, self.settings.search_speed)
            legs = self._run(legs, self._motor(edge + _BACK_OFF, +1), self.settings.search_speed)
            legs = self._run(legs, zero, self.settings.switch_speed)
            self._switch_distance = round((right - zero) * self._steps()) if mode in (2, 3) else 0
            self._append(legs[:-1], searching=True)
            self._zero = zero
            self._append(legs[-1:], searching=False)

    def stop_search(self, t: float) -> None:
        """End a running reference search on the ramp; the counter is then not referenced."""
        if self.searching(t):
            self.rotate(t, 0)

    @property
    def backwards(self) -> bool:
        """Whether the motor turns against what the controller counts."""
        return self.params.reversed != self.settings.reverse_shaft

    def _at_switch(self, t: float, side: int) -> bool:
        """Whether the carriage is at the limit switch that sits at the left (0) or right (1) end."""
        edge = self.params.switches[side] + self._edge
        return self.carriage(t) >= edge - 1e-9 if side else self.carriage(t) <= edge + 1e-9

    def _have(self, t: float, faults: set[str]) -> None:
        """Have these faults from `t` on; a positioning that runs goes on."""
        with self._lock:
            self._faults = faults
            if self._positioning and self.velocity(t):
                self.move_to(t, self._target)
            else:
                self._lose(t, False)

    def _lose(self, t: float, right: bool) -> None:
        """From `t` on steps are lost or not; the counter keeps its value."""
        losing = right and LOST_STEPS in self._faults
        if losing == self._losing or self.searching(t):
            return
        count = self.position(t)
        x, v = self._begin(t)
        self._losing = losing
        self._zero = x - count / self._signed_steps()
        self._append([ramp.Piece(t, x, v, 0.0)], searching=False)

    def _steps(self) -> float:
        """What the counter counts while the motor turns once: more where it loses steps."""
        steps = self.params.steps_per_turn << self.settings.microsteps
        return steps / (1.0 - _LOST) if self._losing else steps

    def _signed_steps(self) -> float:
        return -self._steps() if self.backwards else self._steps()

    def _search_in_vain(self, legs: list[ramp.Piece], direction: int) -> None:
        """Past or away from the switch that it looks for, up to the mechanical end, where it goes on searching."""
        end = self.params.screw.motor(self.params.ends[(direction + 1) // 2], direction)
        start, speed = legs[-1], direction * self.settings.search_speed / self._steps()
        way = ramp.to_velocity(start.t, start.x, 0.0, speed, self._acceleration())
        pieces, self._stalled_at = ramp.clip(legs[:-1] + way, end, direction)
        self._append(pieces, searching=True)

    def _acceleration(self) -> float:
        return max(1, self.settings.max_acceleration) / self._steps()

    def _slopes(self) -> ramp.Slopes:
        settings, steps = self.settings, self._steps()
        up = self._acceleration()
        down = up if settings.max_deceleration is None else max(1, settings.max_deceleration) / steps
        if not settings.first_speed:
            return ramp.Slopes(up, down)
        first, last = max(1, settings.first_acceleration), max(1, settings.last_deceleration)
        return ramp.Slopes(up, down, settings.first_speed / steps, first / steps, last / steps)

    def _motor(self, travel: float, direction: int) -> float:
        return self.params.screw.motor(travel + self._edge, direction)

    def _leg(self, t: float) -> _Leg:
        return self._legs[max(0, bisect_right(self._legs, t, key=lambda leg: leg.piece.t) - 1)]

    def _nut(self, leg: _Leg, t: float) -> float:
        return self.params.screw.follow(leg.nut, leg.piece.at(max(t, leg.piece.t))[0])

    def _begin(self, t: float) -> tuple[float, float]:
        """Forget what was planned after `t`; position and velocity (turns) at `t`."""
        leg = self._leg(t)
        x, v = leg.piece.at(t)
        if self._stalled_at is not None and self._stalled_at > t:
            self._stalled_at = None
        keep = bisect_right(self._legs, t, key=lambda leg: leg.piece.t)
        first = bisect_right(self._legs, t - _KEEP, 0, keep, key=lambda leg: leg.piece.t)
        nut = self._nut(leg, t)
        self._zero = leg.zero
        self._legs = self._legs[max(0, first - 1) : keep]
        self._legs.append(_Leg(ramp.Piece(t, x, v, 0.0), nut, leg.zero, leg.steps, False))
        return x, v

    def _follow(self, pieces: list[ramp.Piece]) -> None:
        """Append a ramp, cut at the switches that are enabled and at the mechanical ends."""
        for direction, enabled in ((-1, self.settings.left_stop), (+1, self.settings.right_stop)):
            side = (direction + 1) // 2
            # A limit switch stops the direction that the controller believes to lead to it.
            if enabled and not self.backwards and EXCHANGED_SWITCHES not in self._faults:
                pieces = self._stop_at(pieces, self._motor(self.params.switches[side], direction), direction)
            end = self.params.screw.motor(self.params.ends[side], direction)
            pieces, stalled = ramp.clip(pieces, end, direction)
            if stalled is not None:
                self._stalled_at = stalled
        self._append(pieces, searching=False)

    def _stop_at(self, pieces: list[ramp.Piece], limit: float, direction: int) -> list[ramp.Piece]:
        cut, time = ramp.clip(pieces, limit, direction)
        if time is None or not self.settings.soft_stop:
            return cut
        x, v = [piece for piece in pieces if piece.t <= time][-1].at(time)
        return cut[:-1] + ramp.to_velocity(time, x, v, 0.0, self._acceleration())

    def _run(self, pieces: list[ramp.Piece], goal: float, pps: int) -> list[ramp.Piece]:
        """Go on from the rest at the end of `pieces` at `pps` until the motor is at `goal`, stopping dead there."""
        start = pieces[-1]
        direction = 1 if goal > start.x else -1
        velocity = direction * pps / self._steps()
        way = ramp.to_velocity(start.t, start.x, 0.0, velocity, self._acceleration())
        return pieces[:-1] + ramp.clip(way, goal, direction)[0]

    def _append(self, pieces: list[ramp.Piece], searching: bool) -> None:
        for piece in pieces:
            last = self._legs[-1]
            nut = self._nut(last, piece.t)
            if last.piece.t == piece.t:
                self._legs.pop()
                nut = last.nut
            self._legs.append(_Leg(piece, nut, self._zero, self._signed_steps(), searching))
