"""Collision-free motions: a direct joint move, else one over corners that OMPL's RRT-Connect finds and shortens.

Source: Kuffner and LaValle, 2000. Every motion is checked all along, between its samples as well, before it is
returned. Moves are joined at rest. The same question gives the same path: the generator is seeded anew for each search,
which ends after so many looks, never by the clock. Where OMPL has no wheel, ways over one corner are tried instead, and
`limits` says so.
"""

import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.motion.collision import CollisionError, CollisionModel, Pair, first_touch
from cell.motion.kinematics import ArmKinematics, Joints
from cell.motion.trajectory import LineLimits, PointSpeed, Trajectory, carried_points, join, plan_joint, plan_line
from drivers.packages import lacking

BRANCH = 1.5
"""Longest branch in rad that the search adds at once."""
CORNERS = 8
"""Free corners of which the shortest way is taken."""
_one_at_a_time = threading.Lock()
"""The library has one source of seeds for the whole process."""


@dataclass(frozen=True)
class Effort:
    """How one search is made: `seed` above 0, `room` in rad around start and end, `step` in rad, most `looks`."""

    seed: int
    room: float
    step: float
    looks: int


def search(
    free: Callable[[Joints], bool], start: Joints, end: Joints,
    ranges: tuple[NDArray[np.float64], NDArray[np.float64]], effort: Effort,
) -> NDArray[np.float64] | None:  # fmt: skip
    """Corners (n, 6) rad of a way from `start` to `end`, straight between them, or None when none was found. `ranges`
    are the least and the greatest joint angles (6,); `free` says whether the arm may stand there."""
    low = np.maximum(ranges[0], np.minimum(start, end) - effort.room)
    high = np.minimum(ranges[1], np.maximum(start, end) + effort.room)
    # Most moves are direct: whoever needs no search does not wait for the library.
    try:
        from ompl import base, geometric, util
    except ModuleNotFoundError:
        return _over_one_corner(free, start, end, (low, high), effort)
    space = base.RealVectorStateSpace(6)
    bounds = base.RealVectorBounds(6)
    for joint in range(6):
        bounds.setLow(joint, float(low[joint]))
        bounds.setHigh(joint, float(high[joint]))
    space.setBounds(bounds)
    left = effort.looks

    def looked(state: object) -> bool:
        nonlocal left
        left -= 1
        return free(_joints(state))

    with _one_at_a_time:
        util.setLogLevel(util.LogLevel.LOG_NONE)
        # Each generator takes its seed, in turn, from the one of the process.
        util.RNG.setSeed(effort.seed)
        info = base.SpaceInformation(space)
        info.setStateValidityChecker(looked)
        info.setStateValidityCheckingResolution(effort.step / space.getMaximumExtent())
        info.setup()
        problem = base.ProblemDefinition(info)
        problem.setStartAndGoalStates(_state(info, start), _state(info, end))
        planner = geometric.RRTConnect(info)
        planner.setRange(BRANCH)
        planner.setProblemDefinition(problem)
        planner.setup()
        planner.solve(base.PlannerTerminationCondition(lambda: left <= 0))
        if not problem.hasExactSolution():
            return None
        path = problem.getSolutionPath()
        simplifier = geometric.PathSimplifier(info)
        simplifier.reduceVertices(path)
        simplifier.ropeShortcutPath(path)
        simplifier.reduceVertices(path)
        return np.array([start, *[_joints(state) for state in path.getStates()[1:-1]], end])


def limits() -> str:
    """What a search here cannot find and why, in words; "" where it is whole."""
    missing = lacking("ompl", "ompl")
    return missing and f" over one corner, and ways over more are not searched: {missing}"


def _over_one_corner(
    free: Callable[[Joints], bool], start: Joints, end: Joints, box: tuple[NDArray[np.float64], NDArray[np.float64]],
    effort: Effort,
) -> NDArray[np.float64] | None:  # fmt: skip
    """The shortest of the first free ways (3, 6) rad over a corner drawn in `box`; None when none was found."""
    drawn = np.random.default_rng(effort.seed)
    best, shortest, found, left = None, np.inf, 0, effort.looks
    while found < CORNERS and left > 0:
        way = np.array([start, drawn.uniform(*box), end])
        length = float(np.abs(np.diff(way, axis=0)).max(axis=1).sum())
        left -= 1
        if length >= shortest:
            continue
        for joints in _along(way, effort.step):
            left -= 1
            if not free(joints):
                break
        else:
            best, shortest, found = way, length, found + 1
    return best


def _along(way: NDArray[np.float64], step: float) -> Iterator[Joints]:
    """Joints (6,) rad on a way (n, 6), no joint farther apart than `step`, each leg from its end: a corner is first."""
    for begin, end in itertools.pairwise(way):
        count = max(1, int(np.ceil(np.abs(end - begin).max() / step)))
        yield from (end + (begin - end) * k / count for k in range(count))


def _joints(state: Any) -> Joints:
    return np.array([state[joint] for joint in range(6)])


def _state(info: Any, joints: Joints) -> Any:
    state = info.allocState()
    for joint, angle in enumerate(joints):
        state[joint] = float(angle)
    return state


EFFORTS = (
    Effort(1, 1.2, 0.05, 8000),
    Effort(2, 2.4, 0.05, 12000),
    Effort(3, 7.0, 0.05, 12000),
    Effort(4, 1.2, 0.02, 12000),
    Effort(5, 7.0, 0.02, 16000),
)
"""The searches, one after the other until a way is found that stays free between its steps."""


class Planner:
    """Plans motions of one arm among one set of bodies. One instance per thread. `tool_speed` in m/s binds every point
    of the flange and of what it carries, in free moves and in lines."""

    def __init__(self, kinematics: ArmKinematics, collisions: CollisionModel, tool_speed: float | None = None) -> None:
        self.kinematics = kinematics
        carried = carried_points(collisions.bodies)
        self._points = None if tool_speed is None else PointSpeed(kinematics, carried, tool_speed)
        self.collisions = collisions
        self.limits = kinematics.limits

    def reach(self, base_from_flange: pin.SE3, seed: Joints, what: str, allowed: Sequence[Pair] = ()) -> Joints:
        """Joint angles of a collision-free posture at the pose, the nearest to `seed`. Raises `kinematics.Unreachable`,
        or `CollisionError` with the bodies that touch in the nearest posture."""
        found = self.kinematics.solutions(base_from_flange, seed)
        if not found:
            self.kinematics.ik(base_from_flange, seed)
        for joints in found:
            if self.collisions.free(joints, allowed):
                return joints
        self.collisions.require_free(found[0], what, allowed)
        return found[0]

    def free(self, start: Joints, end: Joints, allowed: Sequence[Pair] = ()) -> Trajectory:
        """A collision-free joint motion from rest at `start` to rest at `end`; `CollisionError` when none is found."""
        start, end = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64)
        self.collisions.require_free(start, "where the arm stands", allowed)
        self.collisions.require_free(end, "the end of the motion", allowed)
        path = self._path(start, end, tuple(allowed))
        return join([plan_joint(a, b, self.limits, points=self._points) for a, b in itertools.pairwise(path)])

    def line(
        self, start: Joints, base_from_end: pin.SE3, limits: LineLimits | None = None, allowed: Sequence[Pair] = ()
    ) -> Trajectory:
        """A straight line of the flange to `base_from_end`, checked; see `trajectory.plan_line` for its errors."""
        motion = plan_line(self.kinematics, start, base_from_end, limits, points=self._points)
        touch = first_touch(self.collisions, motion.joints, tuple(allowed))
        if touch is not None:
            raise self.collisions.error(f"the straight line at {motion.times[touch.sample]:.2f} s", touch.pairs)
        return motion

    def _path(self, start: Joints, end: Joints, allowed: tuple[Pair, ...]) -> NDArray[np.float64]:
        direct = np.stack([start, end])
        touch = first_touch(self.collisions, direct, allowed)
        if touch is None:
            return direct
        ranges = np.array(self.limits.lower), np.array(self.limits.upper)
        for effort in EFFORTS:
            path = search(lambda joints: self.collisions.free(joints, allowed), start, end, ranges, effort)
            if path is not None and first_touch(self.collisions, path, allowed) is None:
                return path
        raise CollisionError(
            f"no free way was found between joints {np.degrees(start).round(1).tolist()} and "
            f"{np.degrees(end).round(1).tolist()} deg{limits()}. On the straight way "
            f"{', '.join(' and '.join(pair) for pair in touch.pairs)} would come closer than "
            f"{1e3 * self.collisions.margin:.0f} mm. Move the arm to a freer posture with `cell jog` first"
        )
