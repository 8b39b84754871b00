"""Child side: streams a joint trajectory to the arm on absolute deadlines of 2 ms.

Never far ahead of what the arm has reported, so that a stop or a contact is not late by what is still on its way.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

from drivers.arm.child.program import BRAKING_S, PERIOD, SETTLE_S, ControlProgram, End, joints_off
from drivers.arm.messages import ChildSetup, Six, Snapshot, StreamTiming
from drivers.arm.motion import JointTrajectory
from drivers.clock import Clock

_LOOKAHEAD, _GAIN = 0.05, 500
_SERVO_BRAKING = 10.0
_SLIP_S = 0.004
_AHEAD_S, _FEELING_S = 0.04, 0.02
"""How far streaming may run ahead of what the arm has reported, in s on the wall, and where a contact is awaited. What
reaches the arm in one go after a halt of its computer is a jump of so much."""


class Streaming:
    """Streams through ur-rtde's control `interface`, beside which `program` watches and stops the arm."""

    def __init__(
        self, setup: ChildSetup, interface: Any, program: ControlProgram, latest: Callable[[], Snapshot]
    ) -> None:
        self._setup = setup
        self._control = interface
        self._program = program
        self._latest = latest
        self._clock = Clock()
        self._sent: list[float] = []

    @property
    def pace(self) -> StreamTiming | None:
        """How regularly the points of the newest trajectory were sent."""
        return pace_of(self._sent)

    # --- streaming ---

    def stream(self, trajectory: JointTrajectory, force_limit: float | None) -> End:
        """Stream the trajectory, time running `rate` times as fast as the wall, then stand still.

        A stop slows time down to nothing, so that the arm brakes on its way: the controller's own stop takes all its
        time in one command, in which its watchdog would bark.
        """
        self._sent = []
        force_before = self._mean_force() if force_limit is not None else ()
        allowed = _AHEAD_S if force_limit is None else _FEELING_S
        start = time.monotonic()
        seen, lead = self._latest().device_time, 0.0
        cycle, how, text = 0, "", ""
        elapsed, pace, slower, braked_by = 0.0, 1.0, 0.0, math.inf
        self._program.awake(math.inf)
        while not how:
            due = start + cycle * PERIOD
            self._clock.sleep(due - time.monotonic())
            late = time.monotonic() - due
            self._program.awake(PERIOD)
            if late > _SLIP_S:
                # The machine held this thread up. Going on where the arm is told to stand, not where it should have
                # been by now: the latter would be a jump.
                start += late
            newest = self._latest().device_time
            lead, seen = max(0.0, lead - (newest - seen) / self._setup.rate), newest
            if self._program.to_stop.is_set() and not slower:
                slower = PERIOD * self._setup.rate * _SERVO_BRAKING / max(trajectory.speed_at(elapsed), 1e-6)
                braked_by = time.monotonic() + BRAKING_S
            if lead > allowed:
                # The arm would go on unseen, and what is sent would pile up before it and before the next stop.
                start += PERIOD
                self._program.note_late(lead)
                self._program.kick()
            elif self._control.servoJ(list(trajectory.at(elapsed)), 0.0, 0.0, PERIOD, _LOOKAHEAD, _GAIN):
                self._sent.append(time.monotonic())
                cycle += 1
                lead += PERIOD
                elapsed += PERIOD * self._setup.rate * pace
                pace = max(0.0, pace - slower)
            else:
                how, text = self._program.problem() or ("arm.refused", "the controller did not accept a streamed point")
                break
            standing = pace == 0.0 and self._latest().at_rest
            if self._program.to_stop.is_set() and (standing or lead > allowed or time.monotonic() > braked_by):
                how = "stopped"
            else:
                how, text = self._over(trajectory, elapsed, force_before, force_limit)
        self._control.servoStop(_SERVO_BRAKING)
        if how == "arrived":
            return self._program.settled(lambda snapshot: _missed(snapshot, trajectory))
        return self._program.brake() or (how, text) if how in ("stopped", "contact") else (how, text)

    def _over(self, trajectory: JointTrajectory, elapsed: float, before: Six, force_limit: float | None) -> End:
        """Whether streaming is over, and why; an empty reason to go on."""
        snapshot = self._latest()
        if (problem := self._program.problem()) is not None:
            return problem
        if force_limit is not None and math.dist(snapshot.wrench[:3], before) > force_limit:
            return "contact", ""
        late = elapsed - trajectory.duration
        if late >= 0 and (not _missed(snapshot, trajectory) and snapshot.at_rest):
            return "arrived", ""
        if late > SETTLE_S * self._setup.rate:
            return "arm.not_arrived", _missed(snapshot, trajectory) or "the arm does not come to rest"
        return "", ""

    def _mean_force(self) -> Six:
        samples: list[Six] = []
        for _ in range(10):
            samples.append(self._latest().wrench[:3])
            self._clock.sleep(PERIOD)
        return tuple(sum(values) / len(samples) for values in zip(*samples, strict=True))


def _missed(snapshot: Snapshot, trajectory: JointTrajectory) -> str:
    return joints_off(snapshot, trajectory.end, "the trajectory's end")


def pace_of(times: list[float]) -> StreamTiming | None:
    """The pace of points that were sent at these times, s on the wall; None of less than three."""
    if len(times) < 3:
        return None
    gaps = sorted(after - before for before, after in pairwise(times))
    count = len(gaps)
    return StreamTiming(
        len(times), count / (times[-1] - times[0]), gaps[count // 2], gaps[min(count - 1, count * 99 // 100)], gaps[-1]
    )
