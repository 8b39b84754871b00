"""A rail: what it tells, how it moves and sweeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from drivers.interfaces.device import Device, Motion, Vector


@dataclass(frozen=True)
class RailState:
    """Rail reading; `stamp` is the host time (middle of the round trip) at which `position` held.

    `homed` is what the device says, whoever homed it and whenever; `homed_here` that this program did, so that nothing
    can have moved it unseen.
    """

    stamp: float
    position: float
    velocity: float
    homed: bool
    moving: bool
    left_switch: bool
    right_switch: bool
    homed_here: bool = False


class Sweep(Motion, Protocol):
    """A constant-velocity sweep that is being recorded."""

    @property
    def samples(self) -> Vector:
        """Recorded (n, 2) array of host time in s and position in m, so far."""

    @property
    def window(self) -> tuple[float, float]:
        """Host times between which the velocity is constant; known once the sweep has ended."""

    def position_at(self, host_time: float) -> float:
        """Position in m at a host time inside `window`; `ValueError` outside."""

    @property
    def time_bound(self) -> float:
        """Largest error in s of the times behind `position_at`, known once the sweep has ended.

        A reading's time is known within its round trip only. Replies that are all late by as much shift all positions
        by what the rail covers in half of that: nothing in the readings shows it.
        """

    @property
    def unevenness(self) -> float:
        """Median distance in m of the readings from an even motion, beyond what their round trips explain."""


LONGEST_NUDGE_M = 0.010
"""How far a rail is moved at most whose zero nobody knows."""


@runtime_checkable
class Nudged(Protocol):
    """What a rail may offer besides `Rail`: a small motion before its zero is known."""

    def nudge(self, distance: float, speed: float) -> Motion:
        """Move by `distance` m, at most `LONGEST_NUDGE_M` either way, at `speed` m/s, homed or not.

        No travel bounds it, only the limit switches: it is for finding out which way and how far the rail really goes.
        """


@runtime_checkable
class ChecksZero(Protocol):
    """What a rail may offer besides `Rail`: to look whether it has lost steps since it was homed."""

    def check_zero(self) -> Motion | None:
        """Creep over the reference switch and end at 0; None where the switch cannot be asked.

        The motion fails with `DeviceFault` (rail.lost_steps) when the count is off there: then it is not homed any
        more.
        """


class Rail(Device, Protocol):
    """A linear axis that carries the scan head; positions in m from the home switch."""

    travel: tuple[float, float]

    def state(self) -> RailState:
        """Read position, velocity, switches and whether it is homed now.

        Raises `DeviceFault` (rail.reset), once, when the device has lost the zero that it had.
        """

    def home(self) -> Motion:
        """Search the reference switch; position 0 is there afterwards."""

    def move_to(self, position: float, speed: float | None = None) -> Motion:
        """Move to `position`; refused with `InterlockError` before homing, `DeviceFault` when the zero was lost."""

    def sweep(self, start: float, stop: float, speed: float) -> Sweep:
        """Move so that the velocity is constant from `start` to `stop`, with start-up and run-out outside of them.

        The rail has to stand at `sweep_start(start, stop, speed)` already. Position is sampled all the way.
        """

    def sweep_start(self, start: float, stop: float, speed: float) -> float:
        """Where the rail has to stand before `sweep`: `start` less the start-up distance; `LimitError` if outside."""
