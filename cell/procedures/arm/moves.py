"""Moves of the arm as the steps ask for them: free of collisions, jerk-limited, at a pace that a person may lower."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum

import numpy as np
import pinocchio as pin

from cell.config.cell_config import CellConfig, deck_plates, mounted, station_obstacles, vehicle_obstacles
from cell.config.job import Job
from cell.devices.gate.interlocks import Interlocks
from cell.measure.geometry.poses import from_parts, from_ur
from cell.measure.vision.board.view import BoardSpec, centre_of
from cell.motion import collision
from cell.motion.collision import BASE, PLACED, TOUCHES, Body, CollisionError, CollisionModel, Pair, box
from cell.motion.kinematics import HOME, JointLimits, Joints, Unreachable, arm_kinematics
from cell.motion.planning import Planner
from cell.motion.trajectory import LineLimits, Trajectory
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceFault
from drivers.interfaces import Arm, ArmMotion, Vector

THERE = 50e-6
"""With joints so near, rad, to those of a flange pose the arm is left where it stands."""
LEAST = 0.25
"""Slower than this, steps of a usual length would not end within their deadlines."""


class Pace:
    """The `share` holds from the next motion on, until it is set again; any thread may set it.

    Slowed are the arm's motions and the vehicle's ways. Sweeps keep their speed: the lines on the surface would lie
    closer than the job has them.
    """

    def __init__(self) -> None:
        self._share = 1.0

    @property
    def share(self) -> float:
        """Of the planned speed, `LEAST` to 1; raises `ConfigError` when it is set to anything else."""
        return self._share

    @share.setter
    def share(self, share: object) -> None:
        self._share = require_share(share)


def require_share(share: object) -> float:
    """`share` if it is one; raises `ConfigError` that says what is allowed."""
    if not isinstance(share, int | float) or isinstance(share, bool) or not LEAST <= share <= 1.0:
        raise ConfigError(f"pace {share!r}: allowed are {LEAST:g} to 1, of the planned speed")
    return float(share)


def nested_parts(job: Job) -> list[Body]:
    """Parts of other items, as they may lie in their nests."""
    return [_part_at(f"part in the nest of item {k}", nest, job) for k, nest, _ in job.other_items]


def placed_parts(job: Job, base_from_place: pin.SE3) -> list[Body]:
    """Parts of other items, as they may lie in their places, but in the one that is this item's own, too."""
    own = job.surface.place_from_surface.se3() * job.place.surface_from_part.se3()
    others = [(k, place) for k, _, place in job.other_items if not place.isApprox(own)]
    return [_part_at(f"part in the place of item {k}", base_from_place * place, job) for k, place in others]


def _part_at(name: str, base_from_part: pin.SE3, job: Job) -> Body:
    return box(name, BASE, base_from_part * from_parts((0.0, 0.0, 0.5 * job.grasp.size[2])), job.grasp.size)


FAR_SPEED = 0.25
"""m/s, of a straight line where it is not near its place yet, or not any more."""
HEAVY_KG = 14.0
"""Claw and part are lighter than half of it: to speed them up takes no more than half the force that ends a motion."""
RISE_M, RISE_SPEED = 0.05, 0.04
"""How far the arm goes straight up from where it was stopped, m, and how fast, m/s."""
ROOM_ABOVE = 0.005
"""How much higher than drawn the surface is taken to be, m: where it stands is known roughly before it was scanned."""
GRACE_WALL_S = 10.0
"""How much longer than planned a motion may take before it is stopped, in seconds on the wall."""


class Mover:
    """Moves one arm among the bodies that are known so far. Used by one thread at a time.

    `hold` is called before each free motion, at a moment when nothing moves: a paused run waits in it. `interlocks` are
    told of the part and of the station, so that moves that nobody planned are checked against them as well. `pace` says
    how fast, of what is planned. Flange poses are reached with the joints nearest to `near` (6,), rad, or to where the
    arm stands: with others its errors are others, by more than a tenth of a millimetre.
    """

    def __init__(
        self, arm: Arm, clock: Clock, config: CellConfig, job: Job | None, hold: Callable[[], None] = lambda: None,
        interlocks: Interlocks | None = None, pace: Pace | None = None,
    ) -> None:  # fmt: skip
        self.hold = hold
        self.near: Joints | None = None
        self._rests_at: pin.SE3 | None = None
        self.pace = pace or Pace()
        self._arm = arm
        self._clock = clock
        self._settle_time = config.arm.settle_time
        self._tool_speed = config.arm.max_tool_speed
        self._obstacles = [*vehicle_obstacles(config.obstacle), *([] if job is None else nested_parts(job))]
        # Until the vehicle drives, what an earlier run met stands there still.
        known = () if interlocks is None else interlocks.situation.station
        self._station = [body for body in known if body.name != PLACED]
        self._met: list[Body] = []
        most = config.arm.max_joint_speed, config.arm.max_joint_acceleration, config.arm.max_joint_jerk
        speed, acceleration, jerk = ((value,) * 6 for value in most)
        limits = JointLimits(speed=speed, acceleration=acceleration, jerk=jerk)
        self.kinematics = arm_kinematics(config.arm.model, arm.link_table(), limits)
        grasp = None if job is None else job.grasp
        self._interlocks = interlocks
        held, at = (None, None) if grasp is None else (grasp.size, grasp.flange_from_part.se3())
        tool = collision.tool_bodies(held, at, mounted(config))
        self._moving = [*collision.arm_bodies(config.arm.model), *tool, *collision.vehicle_bodies(deck_plates(config))]
        self._planner = self._plan_among(self._station)
        if interlocks is not None and grasp is not None:
            interlocks.carry([body for body in self._moving if body.name == "part"])

    def avoid_station(
        self, base_from_place: pin.SE3, job: Job, board: BoardSpec, surface_extent: tuple[Vector, Vector]
    ) -> None:
        """From now on avoid the station as well, where it was measured. `surface_extent` are the lowest and the highest
        corner (3,) of the nominal surface in its own frame, m."""
        centre = job.place_from_board * from_parts(centre_of(board))
        on_place = job.surface.place_from_surface.se3()
        low, (x, y, z) = (corner.tolist() for corner in surface_extent)
        station = collision.station_bodies(base_from_place, centre, on_place, (low, (x, y, z + ROOM_ABOVE)))
        others = placed_parts(job, base_from_place)
        self._stand_before([*station, *station_obstacles(job.obstacle, base_from_place), *others])

    def empty_claw(self) -> list[Body]:
        """From now on the claw is empty; what it held until now."""
        part = [body for body in self._moving if body.name == "part"]
        self._moving = [body for body in self._moving if body.name != "part"]
        self._stand_before(self._station)
        return part

    def leave_part(self, base_from_part: pin.SE3) -> None:
        """From now on the claw is empty, and the part stands where it was put: it is not to be met again."""
        for part in self.empty_claw():
            self.avoid_part(base_from_part, part.size)

    def avoid_part(self, base_from_part: pin.SE3, size: Sequence[float]) -> None:
        """From now on a part of this size, m, stands there and is not to be met."""
        middle = from_parts((0.0, 0.0, 0.5 * size[2]))
        self._stand_before([*self._station, box(PLACED, BASE, base_from_part * middle, size)])

    def allow_part_contact(self) -> None:
        """From now on the part that was put down may be met: the empty claw goes to take it."""
        self._met = [body for body in self._station if body.name == PLACED]
        self._stand_before([body for body in self._station if body.name != PLACED])

    def forbid_part_contact(self) -> None:
        """From now on that part is not to be met again: it was not taken."""
        self._stand_before([*self._station, *self._met])

    def hold_part(self, flange_from_part: pin.SE3, size: Sequence[float]) -> None:
        """From now on the claw holds a part of this size, m, there."""
        part = [body for body in collision.tool_bodies(size, flange_from_part) if body.name == "part"]
        self._moving = [*self._moving, *part]
        if self._interlocks is not None:
            self._interlocks.carry(part)
        self._stand_before(self._station)

    def solids(self) -> list[Body]:
        """All that goes with the vehicle, where it is with the arm as it stands now, fixed to the base."""
        station = {body.name for body in self._station}
        return [body for body in self._planner.collisions.placed(self.joints) if body.name not in station]

    def _stand_before(self, station: list[Body]) -> None:
        self._station = station
        self._planner = self._plan_among(station)
        if self._interlocks is not None:
            self._interlocks.stand_before(station)

    def _plan_among(self, still: Sequence[Body]) -> Planner:
        bodies = CollisionModel(self.kinematics, [*self._moving, *self._obstacles, *still])
        return Planner(self.kinematics, bodies, tool_speed=self._tool_speed)

    @property
    def joints(self) -> Joints:
        """Where the arm stands, (6,) rad."""
        return self._arm.state().joints

    def plan_to(self, base_from_flange: pin.SE3, what: str) -> Trajectory:
        """A free motion to a flange pose; raises `Unreachable` or `CollisionError` before anything moves."""
        start = self.joints
        joints = self._planner.reach(base_from_flange, start if self.near is None else self.near, what)
        return self._planner.free(start, self.kinematics.unwound(joints, start)).at_pace(self.pace.share)

    def to(self, base_from_flange: pin.SE3, what: str, within: float = 0.0) -> None:
        """Move freely to a flange pose and settle, unless the arm stands there, or `within` so much, m and rad."""
        self.hold()
        off = base_from_flange.inverse() * from_ur(self._arm.state().flange)
        if np.linalg.norm(off.translation) < within and np.linalg.norm(pin.log3(off.rotation)) < within:
            return
        way = self.plan_to(base_from_flange, what)
        if np.abs(way.end - self.joints).max() > THERE:
            self.follow(way)

    def to_as_from(self, near: Joints, base_from_flange: pin.SE3, what: str) -> None:
        """Move freely to a flange pose, from anywhere, with the joints with which it comes there from `near`."""
        joints = self._planner.reach(base_from_flange, near, what)
        self.to_joints(self.kinematics.unwound(joints, self.joints))

    def to_joints(self, joints: Joints, settle: bool = True) -> None:
        """Move freely to joint angles, and `settle` where something is measured there."""
        self.hold()
        self._rise()
        start = self.joints
        self.follow(self._planner.free(start, joints, self._leaving(start)).at_pace(self.pace.share), settle=settle)

    def _leaving(self, start: Joints) -> tuple[Pair, ...]:
        """What may be near the part that was just put down: only what is so already."""
        return tuple(pair for pair in self._planner.collisions.touching(start) if PLACED in pair)

    def _rise(self) -> None:
        """Straight up, where the arm was stopped so near to the station that no way can be planned from there."""
        if any(set(pair) & {"surface", "table"} for pair in self._planner.collisions.touching(self.joints)):
            self.line(from_parts((0.0, 0.0, RISE_M)) * from_ur(self._arm.state().flange), RISE_SPEED, TOUCHES)

    def to_view(self, base_from_flange: pin.SE3) -> None:
        """Move freely to a view of a calibration with the calibration's joints, those nearest to HOME. Raises
        `Unreachable`, or `CollisionError` where these joints are not free."""
        self.to_joints(self.kinematics.unwound(self.kinematics.ik(base_from_flange, HOME), self.joints))

    def rest_at(self, base_from_flange: pin.SE3) -> None:
        """From now on the arm rests there between jobs, if it can with what is in the claw now."""
        with suppress(Unreachable, CollisionError):
            self._planner.reach(base_from_flange, HOME, "where the arm rests between jobs")
            self._rests_at = base_from_flange

    def fold(self) -> None:
        """Bring the arm to where it rests between jobs: as `rest_at` has it, else HOME."""
        if self._rests_at is not None:
            with suppress(Unreachable, CollisionError):
                joints = self._planner.reach(self._rests_at, HOME, "where the arm rests between jobs")
                return self.to_joints(self.kinematics.unwound(joints, self.joints), settle=False)
        return self.to_joints(HOME, settle=False)

    def line(
        self, base_from_flange: pin.SE3, speed: float, allowed: Sequence[Pair] = (), *,
        force_limit: float | None = None, settle: bool = True, near: float = 0.0, leaving: bool = False,
    ) -> bool:  # fmt: skip
        """Move the flange in a straight line; True when it ended early in contact, at `force_limit` N. With `near`, m,
        only so much of its end, or of its beginning when `leaving`, goes at `speed`; the rest faster."""
        far = min(max(speed, FAR_SPEED) if near else speed, self._tool_speed)
        acceleration = max(0.02, min(3.0 * far, np.inf if force_limit is None else force_limit / HEAVY_KG))
        slow, jerk = min(speed, far), 8.0
        stopping = 1.1 * (0.5 * slow**2 / acceleration + 0.5 * slow * acceleration / jerk)
        limits = LineLimits(
            speed=far, acceleration=acceleration, jerk=jerk, near=max(near, stopping) if near else 0.0, near_speed=slow,
            leaving=leaving,
        )  # fmt: skip
        line = self._planner.line(self.joints, base_from_flange, limits, allowed)
        return self.follow(line.at_pace(self.pace.share), force_limit, settle)

    def plan_line(
        self, base_from_start: pin.SE3, base_from_end: pin.SE3, speed: float
    ) -> tuple[Trajectory, Trajectory]:
        """A free motion to the start of a straight line, and the line itself at `speed` m/s; nothing moves yet."""
        way = self.plan_to(base_from_start, "the start of the line")
        limits = LineLimits(speed=min(speed, self._tool_speed), acceleration=max(0.02, 3.0 * speed), jerk=8.0)
        return way, self._planner.line(way.end, base_from_end, limits)

    def begin(self, trajectory: Trajectory) -> tuple[ArmMotion, float]:
        """Have the arm begin a trajectory; the motion, and in how many seconds it must have ended."""
        motion = self._arm.follow(trajectory.times, trajectory.joints)
        return motion, 3.0 * trajectory.duration + GRACE_WALL_S * self._clock.rate

    def follow(self, trajectory: Trajectory, force_limit: float | None = None, settle: bool = True) -> bool:
        """Have the arm follow a trajectory to its end, and `settle`; True when it ended early in contact."""
        motion = self._arm.follow(trajectory.times, trajectory.joints, force_limit)
        motion.wait(3.0 * trajectory.duration + GRACE_WALL_S * self._clock.rate)
        if settle:
            self._clock.sleep(self._settle_time)
        return motion.contact


def moved_once_more(arm: Arm, move: Callable[[], None]) -> None:
    """Do `move`; once more after a fault of the arm that a program may clear by itself, such as a lost program. After a
    protective stop this is refused: a person has to look first."""
    try:
        move()
    except DeviceFault as fault:
        if fault.device != arm.name or not fault.recoverable:
            raise
        arm.recover()
        move()


class PartState(Enum):
    """Where the part is, as far as the claw's commands and its feedback tell."""

    LIES = "at the station"
    NESTED = "in its nest"
    HELD = "held"
    UNKNOWN = "unknown"
    RELEASED = "released"

    @property
    def untaken(self) -> bool:
        """Whether it lies where it is to be taken from: the claw is empty."""
        return self in (PartState.LIES, PartState.NESTED)

    @classmethod
    def first(cls, job: Job) -> "PartState":
        """Where the part of a job is before it."""
        return cls.HELD if job.nest is None else cls.LIES if job.unloads else cls.NESTED


@dataclass(eq=False)
class PartProgress:
    """What has become of the part, kept beside the step: a run may be ended by others while the part is on its way.
    `where` is base_from_part of a part that lies, None while it is held; `left` tells whether the arm has gone up."""

    state: PartState = PartState.HELD
    where: pin.SE3 | None = None
    left: bool = False

    def explain(self, reason: str) -> str:
        """A run's reason, not to be read without what has become of the part."""
        if self.state is PartState.HELD or self.state.untaken or self.where is None:
            return reason
        x, y, z = 1e3 * self.where.translation
        at = f"at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the arm base"
        if self.state is PartState.RELEASED:
            failed = "" if self.left else ", only the retreat failed"
            return f"the part is already down {at} and is not to be placed again{failed}: {reason}"
        return f"the claw was told to open or close on the part {at}, look whether it did: {reason}"
