"""Child side: streams a joint trajectory to the arm on absolute deadlines of 2 ms.

Never far ahead of what the arm has reported, so that a stop or a contact is not late by what is still on its way.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from drivers.arm.child.program import BRAKING_S, PERIOD, SETTLE_S, ControlProgram, End, joints_off
from drivers.arm.feed import ChildSetup, Six, Snapshot, StreamTiming
from drivers.arm.motion import JointTrajectory
from drivers.clock import Clock

if TYPE_CHECKING:
    from rtde_control import RTDEControlInterface

_LOOKAHEAD, _GAIN = 0.05, 500
_SERVO_BRAKING = 10.0
_SLIP_S = 0.004
_AHEAD_S, _FEELING_S = 0.04, 0.02
"""How far streaming may run ahead of what the arm has reported, in s on the wall, and where a contact is awaited. What
reaches the arm in one go after a halt of its computer is a jump of so much."""


@dataclass
class _Course:
    """How far a stream has come.

    Cycle 0 began at `start`, s of the machine's clock; the arm's clock showed `seen` when it was last looked at.
    `cycle` counts points that went out, which run `lead` s ahead of the arm. `elapsed` s of the trajectory are sent;
    time runs at `pace`, which becomes `slower` in each cycle of a stop, and that ends at `braked_by` at the latest.
    """

    start: float
    seen: float
    cycle: int = 0
    lead: float = 0.0
    elapsed: float = 0.0
    pace: float = 1.0
    slower: float = 0.0
    braked_by: float = math.inf


class Streaming:
    """Streams through ur-rtde's control `interface`, beside which `program` watches and stops the arm."""

    def __init__(
        self, setup: ChildSetup, interface: RTDEControlInterface, program: ControlProgram,
        latest: Callable[[], Snapshot],
    ) -> None:  # fmt: skip
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

    def stream(self, trajectory: JointTrajectory, force_limit: float | None) -> End:
        """Stream the trajectory, time running `rate` times as fast as the wall, then stand still.

        A stop slows time down to nothing, so that the arm brakes on its way: the controller's own stop takes all its
        time in one command, in which its watchdog would bark.
        """
        self._sent = []
        force_before = self._mean_force() if force_limit is not None else ()
        allowed = _AHEAD_S if force_limit is None else _FEELING_S
        course = _Course(time.monotonic(), self._latest().device_time)
        how, text = "", ""
        self._program.awake(math.inf)
        while not how:
            self._wait_for_cycle(course)
            self._begin_to_brake(course, trajectory)
            if course.lead > allowed:
                # The arm would go on unseen, and what is sent would pile up before it and before the next stop.
                course.start += PERIOD
                self._program.note_late(course.lead)
                self._program.kick()
            elif not self._send(course, trajectory):
                how, text = self._program.problem() or ("arm.refused", "the controller did not accept a streamed point")
                break
            if self._program.to_stop.is_set() and self._braked(course, allowed):
                how = "stopped"
            else:
                how, text = self._over(trajectory, course.elapsed, force_before, force_limit)
        self._control.servoStop(_SERVO_BRAKING)
        if how == "arrived":
            return self._program.settled(lambda snapshot: _missed(snapshot, trajectory))
        return self._program.brake() or (how, text) if how in ("stopped", "contact") else (how, text)

    def _wait_for_cycle(self, course: _Course) -> None:
        """Sleep until the next point is due, and see how far the arm has come."""
        due = course.start + course.cycle * PERIOD
        self._clock.sleep(due - time.monotonic())
        late = time.monotonic() - due
        self._program.awake(PERIOD)
        if late > _SLIP_S:
            # The machine held this thread up. Going on where the arm is told to stand, not where it should have
            # been by now: the latter would be a jump.
            course.start += late
        newest = self._latest().device_time
        course.lead = max(0.0, course.lead - (newest - course.seen) / self._setup.rate)
        course.seen = newest

    def _begin_to_brake(self, course: _Course, trajectory: JointTrajectory) -> None:
        """After a stop, once: how much slower time becomes in each cycle."""
        if self._program.to_stop.is_set() and not course.slower:
            speed = max(trajectory.speed_at(course.elapsed), 1e-6)
            course.slower = PERIOD * self._setup.rate * _SERVO_BRAKING / speed
            course.braked_by = time.monotonic() + BRAKING_S

    def _send(self, course: _Course, trajectory: JointTrajectory) -> bool:
        """Send the next point; False when the controller does not take it."""
        unused_speed = unused_acceleration = 0.0
        how = unused_speed, unused_acceleration, PERIOD, _LOOKAHEAD, _GAIN
        if not self._control.servoJ(list(trajectory.at(course.elapsed)), *how):
            return False
        self._sent.append(time.monotonic())
        course.cycle += 1
        course.lead += PERIOD
        course.elapsed += PERIOD * self._setup.rate * course.pace
        course.pace = max(0.0, course.pace - course.slower)
        return True

    def _braked(self, course: _Course, allowed: float) -> bool:
        """Whether streaming may end for a stop: the arm stands, is not seen, or takes too long."""
        standing = course.pace == 0.0 and self._latest().at_rest
        return standing or course.lead > allowed or time.monotonic() > course.braked_by

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
