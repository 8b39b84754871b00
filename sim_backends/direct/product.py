"""What the devices in this process are given from outside: settings, and logic of the product's own drivers.

Nothing here knows a driver. Logic that is worth proving on the virtual clock as well, because results rest on it, comes
from whoever puts the cell together: the fit of a sweep, the comparison of clocks, odometry, the arm's limits, and the
words of faults. What is only a protocol's business is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from drivers.clock import Latch
from drivers.errors import DeviceFault, LimitError
from drivers.interfaces import Vector


class SweepLine(Protocol):
    """The line through the readings of a sweep; see `Sweep` in `drivers.interfaces` for the figures."""

    @property
    def velocity(self) -> float:
        """In m/s."""

    @property
    def time_bound(self) -> float:
        """In s."""

    @property
    def unevenness(self) -> float:
        """In m."""

    def position_at(self, time: float) -> float:
        """Position in m at a host time in s."""

    def time_at(self, position: float) -> float:
        """Host time in s at a position in m."""


class HostTimeMap(Protocol):
    """The way from a device's clock to the host's, from latches (host before, device, host after), s."""

    def add(self, latches: Iterable[Latch]) -> None:
        """Take the latches of one moment."""

    def host_time(self, device: float) -> float:
        """Host time in s for a device's time in s."""

    @property
    def uncertainty(self) -> float:
        """Bound in s on the error of `host_time`."""


class Odometry(Protocol):
    """Where the vehicle is by its wheels' counters: x, y in m and yaw in rad from where it stood first."""

    x: float
    y: float
    yaw: float

    def update(self, left: int, right: int, farthest: float) -> bool:
        """Take both counters in mm; a jump of more than `farthest` m is not counted."""


class ArmLimitChecks(Protocol):
    """What the arm may be asked; each check raises `LimitError` and gives back what it was given."""

    def check_joints(self, device: str, joints: Vector) -> Vector:
        """Joint angles (6,), rad."""

    def check_pose(self, device: str, flange: Vector) -> Vector:
        """Flange pose (6,)."""

    def check_joint_move(self, device: str, speed: float, acceleration: float) -> None:
        """Speed in rad/s and acceleration in rad/s² of the leading joint."""

    def check_linear_move(self, device: str, speed: float, acceleration: float) -> None:
        """Speed in m/s and acceleration in m/s² of the flange."""

    def check_payload(self, device: str, mass: float, centre: Vector) -> tuple[float, tuple[float, float, float]]:
        """Mass in kg and centre of gravity (3,), m."""

    def check_trajectory(self, device: str, times: Vector, joints: Vector) -> tuple[Vector, Vector]:
        """Times (n,), s, and joints (n, 6), rad."""


@dataclass(frozen=True)
class ArmSetup:
    """The arm's limits, the words of its faults (device, code, text), and the outputs that are off after a recovery."""

    limits: ArmLimitChecks
    fault: Callable[[str, str, str], DeviceFault]
    safe_off: tuple[int, ...]


class CarriageCheck(Protocol):
    """Whether the carriage goes where it is sent."""

    def __call__(self, position: float, left: bool, right: bool, stalled: Callable[[], bool]) -> None:
        """Judge a reading: position in m, both limit switches, and what asks for a stall; raises `DeviceFault`."""


@dataclass(frozen=True)
class RailSetup:
    """How the rail is driven: m, m/s, m/s²; `reversed` turns its motor round; `even` fits a sweep from times,
    positions and round trips (n,) each.

    `watch` takes the rail's name, its clock and its travel in m, None for a nudge.
    `check` takes the rail's name, how it is sent, its count, its home switch, how its zero is given up, and its speed.
    `serial` is the number by which the cell knows it; None where it tells its own.
    """

    lead: float
    steps_per_turn: int
    microsteps: int
    travel: tuple[float, float]
    max_speed: float
    acceleration: float
    reversed: bool
    even: Callable[[Vector, Vector, Vector], SweepLine]
    watch: Callable[[str, Any, float | None], CarriageCheck]
    check: Callable[..., Callable[[], bool]]
    serial: str | None = None


@dataclass(frozen=True)
class VehicleSetup:
    """Limits in m/s and rad/s; `trouble` tells error bits in words, `error` makes a fault of them.

    `error` takes the device's name, its error bits, their words, and whether it was driven lately. `make` is what it
    calls itself, `count` the way of a side, m, that its counters count in.
    """

    max_speed: float
    max_yaw_rate: float
    odometry: Odometry
    trouble: Callable[[int], tuple[str, ...]]
    error: Callable[[str, int, tuple[str, ...], bool], DeviceFault]
    make: str
    count: float


@dataclass(frozen=True)
class CameraSetup:
    """`clock_map` makes an empty map for one camera, `latch` what is added to it."""

    clock_map: Callable[[], HostTimeMap]
    latch: Callable[[float, float, float], Latch]


@dataclass(frozen=True)
class DirectSetup:
    """Everything that the devices are given."""

    arm: ArmSetup
    rail: RailSetup
    vehicle: VehicleSetup
    camera: CameraSetup


def within(device: str, what: str, value: float, low: float, high: float, unit: str) -> float:
    """`value` if it lies between `low` and `high`, else `LimitError`; lengths are shown in mm, angles as they are."""
    number = float(value)
    if low <= number <= high:
        return number
    scale, shown = (1e3, f"m{unit}") if unit.startswith("m") else (1.0, unit)
    raise LimitError(
        device,
        f"{what} {number * scale:.6g} {shown} is outside {low * scale:.6g} {shown} to {high * scale:.6g} {shown}; "
        f"nothing was sent. Choose a {what} in this range.",
    )
