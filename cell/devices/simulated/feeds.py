"""What real devices measure of themselves, as rows for a simulated world that follows them; reading only.

A row is the host time at which it held, s, and the device's numbers, as `sim_backends.world.following` has them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from cell.devices.devices import Devices
from cell.devices.gate.gated import GatedArm
from drivers.interfaces import ArmState

Rows = list[list[float]]

PERIOD_S, AT_REST_S = 0.008, 0.02
"""Wall seconds between two looks for readings, of what moves and of what stands; the world waits for them with its
pictures."""
FINEST_S = 0.0039
"""Of an arm's states, which come each 2 ms, so many are told while it moves."""
DRIFT_S = 0.2e-6
"""What an arm's clock may drift from one state to the next: 100 ppm of 2 ms."""


class Feed(Protocol):
    """The readings of one device."""

    def open(self) -> AbstractContextManager[Callable[[], Rows]]:
        """While it is open: a function that gives the rows since it was called last, oldest first."""


class ArmFeed:
    """Joints, whether it moves, outputs; by the arm's own clock, which the way over the wire does not jolt."""

    def __init__(self, devices: Devices) -> None:
        arm = devices.arm
        # Its own force alone: what the simulated part touches is what comes back from the world.
        self._arm = arm.bare if isinstance(arm, GatedArm) else arm
        self._ahead: float | None = None
        self._newest, self._outputs = 0.0, -1

    @contextmanager
    def open(self) -> Iterator[Callable[[], Rows]]:
        """See `Feed.open`."""
        with self._arm.record() as states:
            yield lambda: self._rows(states)

    def time(self, state: ArmState) -> float:
        """Host time at which a state held: the one that came fastest tells how far the arm's clock is ahead."""
        if state.device_time <= 0.0:
            return state.stamp
        ahead = state.stamp - state.device_time
        if self._ahead is None or abs(ahead - self._ahead) > 1.0:
            self._ahead = ahead
        return state.device_time + self._ahead

    def _rows(self, states: list[ArmState]) -> Rows:
        batch = list(states)
        del states[: len(batch)]
        rows: Rows = []
        for k, state in enumerate(batch):
            t = self.time(state)
            if self._ahead is not None and state.device_time > 0.0:
                self._ahead = min(self._ahead + DRIFT_S, state.stamp - state.device_time)
            told = k == len(batch) - 1 or (state.moving and t - self._newest >= FINEST_S)
            if told or state.digital_outputs != self._outputs:
                self._newest, self._outputs = t, state.digital_outputs
                rows.append([t, *map(float, state.joints), float(state.moving), float(state.digital_outputs)])
        return rows


class RailFeed:
    """Position: a sweep's readings as they come; at rest, where the last motion has brought it, for nothing else does.

    It is not asked while it rests, nor while it moves without being recorded: that would take its line's time.
    """

    def __init__(self, devices: Devices) -> None:
        self._rail, self._clock = devices.rail, devices.clock

    @contextmanager
    def open(self) -> Iterator[Callable[[], Rows]]:
        """See `Feed.open`."""
        self._arrived = self._seen = self._rail.motion
        self._told, self._position = 0, self._rail.state().position
        self._looked = self._clock.now()
        yield self._rows

    def _rows(self) -> Rows:
        before, self._looked = self._looked, self._clock.now()
        motion, rows = self._rail.motion, []
        if motion is not self._seen:
            self._seen, self._told = motion, 0
        if motion is not None and (samples := getattr(motion, "samples", None)) is not None:
            rows = [[float(t), float(position)] for t, position in samples[self._told :]]
            self._told += len(rows)
        if motion is not None and not motion.done:
            return rows
        if motion is not self._arrived:
            state = self._rail.state()
            if state.moving:
                return rows
            self._arrived, self._position = motion, state.position
            # It has ended since the last look, with the carriage at rest: whoever waited for it may expose at once.
            rows.append([before, self._position])
        return [*rows, [self._clock.now(), self._position]]


class VehicleFeed:
    """Odometry, speeds, and whether it is braked."""

    def __init__(self, devices: Devices) -> None:
        self._vehicle = devices.vehicle
        self._newest = float("-inf")

    @contextmanager
    def open(self) -> Iterator[Callable[[], Rows]]:
        """See `Feed.open`."""
        yield self._rows

    def _rows(self) -> Rows:
        state = self._vehicle.state()
        if state.stamp <= self._newest:
            return []
        self._newest = state.stamp
        numbers = (state.stamp, state.x, state.y, state.yaw, state.speed, state.yaw_rate, bool(state.braked))
        return [[float(number) for number in numbers]]


class SwitchFeed:
    """Whether a laser or claw is on that does not hang on the arm."""

    def __init__(self, devices: Devices, is_on: Callable[[], bool]) -> None:
        self._clock, self._is_on = devices.clock, is_on

    @contextmanager
    def open(self) -> Iterator[Callable[[], Rows]]:
        """See `Feed.open`."""
        yield lambda: [[self._clock.now(), float(self._is_on())]]
