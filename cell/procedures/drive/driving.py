"""Driving on odometry: poses in the plane, along a line to its end, and turning on the spot. Units: m, rad, s."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pinocchio as pin

from drivers.clock import Clock
from drivers.errors import DeviceFault
from drivers.interfaces import Vehicle, VehicleState

CONTROL_PERIOD_S = 0.04
DECELERATION = 0.25  # m/s², below what the vehicle can do, so that it stops where it was told to
CREEP = 0.015  # m/s, the slowest speed that is commanded while a distance remains
LINE_GAIN = 2.2  # rad of heading per m beside the line
HEADING_GAIN = 2.0  # 1/s
TURN_GAIN = 1.5  # 1/s
MAX_HEADING = math.radians(25)
MAX_TURN_RATE = math.radians(25)
ARRIVED = 0.0005  # m
FRESH_S = 0.1  # s on the wall; feedback up to this old says whether the vehicle is there, it comes every 0.02 s


@contextmanager
def driven(vehicle: Vehicle) -> Iterator[None]:
    """The vehicle enabled inside this context, and braked behind it whatever happens."""
    vehicle.enable()
    try:
        yield
    finally:
        vehicle.brake()


@dataclass(frozen=True)
class Planar:
    """A pose in the plane: m, m, rad."""

    x: float
    y: float
    yaw: float

    @classmethod
    def of(cls, pose: pin.SE3) -> "Planar":
        """The planar part of a spatial pose."""
        return cls(pose.translation[0], pose.translation[1], math.atan2(pose.rotation[1, 0], pose.rotation[0, 0]))

    def __mul__(self, other: "Planar") -> "Planar":
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return Planar(
            self.x + c * other.x - s * other.y, self.y + s * other.x + c * other.y, wrap(self.yaw + other.yaw)
        )

    def inverse(self) -> "Planar":
        """The pose that undoes this one."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return Planar(-c * self.x - s * self.y, s * self.x - c * self.y, wrap(-self.yaw))


def wrap(angle: float) -> float:
    """The angle in (−π, π]."""
    return math.remainder(angle, 2 * math.pi)


def line_command(pose: Planar, goal: Planar, speed: float) -> tuple[float, float]:
    """Speed in m/s and yaw rate in rad/s that bring a vehicle at `pose` along the goal's line to the goal.

    The line runs through `goal` along its heading. Forwards or backwards, whichever leads there; the speed falls so
    that the vehicle can stop at the goal. (0, 0) once it is there or past it within 0.5 mm.
    """
    error = goal.inverse() * pose
    remaining = -error.x
    if abs(remaining) < ARRIVED:
        return 0.0, 0.0
    magnitude = max(CREEP, min(speed, math.sqrt(2 * DECELERATION * abs(remaining))))
    v = math.copysign(magnitude, remaining)
    wanted = np.clip(-LINE_GAIN * error.y, -MAX_HEADING, MAX_HEADING) * math.copysign(1.0, v)
    # The correction fades at low speed: a vehicle that creeps cannot move sideways, it can only spoil its heading.
    fade = min(1.0, magnitude / 0.1)
    turn = np.clip(HEADING_GAIN * wrap(fade * wanted - error.yaw), -MAX_TURN_RATE, MAX_TURN_RATE)
    return v, float(turn)


class Located(Protocol):
    """Knows where the vehicle is, by odometry."""

    def pose(self) -> Planar:
        """The pose now."""


class RelativeOdometry:
    """The vehicle's pose relative to where it stood when this was made."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._start_from_odometry = odometry_of(vehicle.state()).inverse()

    def pose(self) -> Planar:
        """The pose now."""
        return self._start_from_odometry * odometry_of(self._vehicle.state())


class _SinceNews:
    """How far a vehicle has gone, by its commands, since the feedback that odometry tells of."""

    def __init__(self, vehicle: Vehicle, clock: Clock) -> None:
        self._vehicle, self._clock = vehicle, clock
        self._stamp, self._looked, self._gone = -math.inf, 0.0, Planar(0.0, 0.0, 0.0)

    def look(self, speed: float, yaw_rate: float) -> tuple[Planar, bool]:
        """The way gone since then, of it at `speed` and `yaw_rate` since the last look, and whether the news are so
        fresh that they say whether it is there."""
        now, stamp = self._clock.now(), self._vehicle.state().stamp
        if stamp != self._stamp:
            self._stamp, self._gone = stamp, Planar(0.0, 0.0, 0.0)
        else:
            self._gone *= Planar(speed * (now - self._looked), 0.0, yaw_rate * (now - self._looked))
        self._looked = now
        return self._gone, now - stamp <= FRESH_S * max(1.0, self._clock.rate)


def odometry_of(state: VehicleState) -> Planar:
    """The pose that the vehicle's odometry tells."""
    return Planar(state.x, state.y, state.yaw)


def drive_line(
    vehicle: Vehicle, odometry: Located, goal: Planar, speed: float, clock: Clock, check: Callable[[], None]
) -> None:
    """Drive along the goal's line and stop at the goal, on odometry. `check` raises when the run is to end.

    Feedback that comes late finds the vehicle further on: it slows down for that, and stands where it may have arrived
    until newer feedback tells.
    """
    distance = abs((goal.inverse() * odometry.pose()).x)
    deadline = clock.now() + 10.0 + 3.0 * (distance / speed + speed / DECELERATION + 0.1 / CREEP)
    since_news = _SinceNews(vehicle, clock)
    direction = v = w = 0.0
    while True:
        check()
        gone, fresh = since_news.look(v, w)
        v, w = line_command(odometry.pose() * gone, goal, speed)
        if v == 0.0 or direction * v < 0:  # there, or just past it
            if fresh:
                break
            v = w = 0.0
        direction = v or direction
        if clock.now() > deadline:
            vehicle.stop()
            raise _blocked(f"did not arrive at x = {goal.x:.3f} m in time")
        vehicle.drive(v, w)
        clock.sleep(CONTROL_PERIOD_S)
    vehicle.stop()


def _blocked(what: str) -> DeviceFault:
    """A vehicle that does not come along: driving against what blocks it once more is not for a program to decide."""
    return DeviceFault(
        "vehicle", "vehicle.blocked", f"it {what}", recoverable=False,
        hint="Look what blocks it or where its wheels slip, and jog it away from there. Then run the job again.",
    )  # fmt: skip


def turn_to(vehicle: Vehicle, odometry: Located, yaw: float, clock: Clock, check: Callable[[], None]) -> None:
    """Turn on the spot to `yaw` in the place frame, on odometry, to 0.1°."""
    deadline = clock.now() + 20.0
    since_news, rate = _SinceNews(vehicle, clock), 0.0
    while True:
        check()
        gone, fresh = since_news.look(0.0, rate)
        error = wrap(yaw - odometry.pose().yaw - gone.yaw)
        there = abs(error) <= math.radians(0.1)
        if there and fresh:
            break
        if clock.now() > deadline:
            vehicle.stop()
            raise _blocked(f"did not turn by {math.degrees(error):.2f} deg in time")
        rate = (
            0.0 if there else math.copysign(max(math.radians(0.6), min(MAX_TURN_RATE, TURN_GAIN * abs(error))), error)
        )
        vehicle.drive(0.0, rate)
        clock.sleep(CONTROL_PERIOD_S)
    vehicle.stop()
