"""What is known about where the vehicle stands: nothing, or its pose by odometry since it was seen or said.

Odometry counts from wherever the driver was opened. It tells a place only from an anchor on: a sighting of the board,
or a person's word that the vehicle stands at its start. The anchor is lost with the driver, with its link, and when
somebody else moved or commanded the vehicle meanwhile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from cell.config.job import BoardSection, Job
from cell.procedures.drive.approach import Planar, wrap
from drivers.errors import RefusedError
from drivers.interfaces import Vehicle, VehicleState

PLAUSIBLE = 0.10
"""A sighting this far, m, from what odometry says is worth a note."""
PLAUSIBLE_ANGLE = math.radians(5)
TIGHT = 0.3
"""Turns about a point nearer than this, m, count as on the spot: about half the track, the wheels go against each
other and scrub. Wider ones are part of the way."""


@dataclass(frozen=True)
class _Anchor:
    """`pose` in the place frame, or None for the start pose of the job to come, at the odometry's `reading`."""

    pose: Planar | None
    reading: Planar
    interruptions: int


class Whereabouts:
    """The vehicle's pose in the place frame as far as it is known. One for each connected vehicle, used by one thread.

    `way` is how far it has gone, m, and `turned` how far it has turned on the spot, rad, either way, since it was seen
    or said: what odometry may be off by grows with both.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._anchor: _Anchor | None = None
        self._board: BoardSection | None = None
        self._unknown = "this program has just connected to it"
        self._last = Planar(0.0, 0.0, 0.0)
        self.way = self.turned = 0.0

    @property
    def anchored(self) -> bool:
        """Whether a run of this program has worked from a known place already."""
        return self._anchor is not None and self._anchor.pose is not None

    def say_at_start(self) -> None:
        """Take somebody's word that the vehicle stands at the start pose of the job that is run next."""
        self._hold(None)

    def forget_word(self) -> None:
        """The word that was given for one job does not hold for the next, if that job never came to use it."""
        if self._anchor is not None and self._anchor.pose is None:
            self._lose("it was said to stand at the start of another job, which did not begin to drive")

    def enter(self, job: Job) -> None:
        """From now on poses are in the place frame of `job`."""
        if self._anchor is not None and self._anchor.pose is None:
            self._anchor = _Anchor(
                Planar.of(job.approach.start.se3()), self._anchor.reading, self._anchor.interruptions
            )
        elif self._anchor is not None and self._board != job.board:
            self._lose("it was last seen by the board of another job")
        self._board = job.board

    def see(self, seen: Planar) -> str | None:
        """The board shows the vehicle at `seen`, standing: odometry counts from there.

        The sighting wins: the job is done by the board, odometry only bridges the way to it, and slips. What
        contradicts odometry by more than `PLAUSIBLE` is returned as a note.
        """
        try:
            before = self.pose()
        except RefusedError:
            before = None
        self._hold(seen)
        if before is None:
            return None
        apart, turned = math.hypot(seen.x - before.x, seen.y - before.y), abs(wrap(seen.yaw - before.yaw))
        if apart <= PLAUSIBLE and turned <= PLAUSIBLE_ANGLE:
            return None
        return (
            f"the board shows the vehicle {1e3 * apart:.0f} mm and {math.degrees(turned):.1f} deg from where odometry "
            f"had it (expected within {1e3 * PLAUSIBLE:.0f} mm and {math.degrees(PLAUSIBLE_ANGLE):.0f} deg); "
            "the board is believed. Look whether its wheels slip, it was pushed, or it did not stand at its start"
        )

    def pose(self) -> Planar:
        """The pose now, by odometry; `RefusedError` that says why when it is not known."""
        state = self._vehicle.state()
        if self._anchor is not None and state.interruptions != self._anchor.interruptions:
            self._lose(state.interruption)
        if self._anchor is None or self._anchor.pose is None:
            raise RefusedError(f"where the vehicle stands is not known: {self._unknown}")
        return self._anchor.pose * self._anchor.reading.inverse() * self._count(state)

    def count(self) -> None:
        """Count what it has gone since the last look; for those who drive it by other means than `pose`, all the time.

        A way there and back is none between two looks.
        """
        self._count(self._vehicle.state())

    def _count(self, state: VehicleState) -> Planar:
        now = _reading(state)
        way, turn = math.hypot(now.x - self._last.x, now.y - self._last.y), abs(wrap(now.yaw - self._last.yaw))
        self.way += way
        if way < TIGHT * turn:
            self.turned += turn
        self._last = now
        return now

    def _hold(self, pose: Planar | None) -> None:
        state = self._vehicle.state()
        self._anchor = _Anchor(pose, _reading(state), state.interruptions)
        self._last, self.way, self.turned = self._anchor.reading, 0.0, 0.0

    def _lose(self, why: str) -> None:
        self._anchor, self._unknown = None, why


def next_step(job: Job) -> str:
    """What a person can do about a vehicle that does not know where it stands."""
    start = Planar.of(job.approach.start.se3())
    return (
        "Nothing was driven. Bring the vehicle where it sees the board, with `cell jog vehicle`; or put it at the "
        f"job's start (x {start.x:.2f} m, y {start.y:.2f} m, {math.degrees(start.yaw):.0f} deg in the place frame) and "
        "say so with --at-start"
    )


def _reading(state: VehicleState) -> Planar:
    return Planar(state.x, state.y, state.yaw)
