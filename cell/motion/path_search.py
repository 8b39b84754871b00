"""A way through joint space, found by OMPL's RRT-Connect (Kuffner and LaValle, 2000) and shortened by it.

It is looked at in steps: whoever uses it checks the way in between as well. The same question gives the same way: the
generator is seeded anew for each search, and a search ends after so many looks, never by the clock.

Where OMPL has no wheel, ways over one corner are tried instead: `limits` says so. Narrow passages need OMPL.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.motion.kinematics import Joints
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
    free: Callable[[Joints], bool],
    start: Joints,
    end: Joints,
    ranges: tuple[NDArray[np.float64], NDArray[np.float64]],
    effort: Effort,
) -> NDArray[np.float64] | None:
    """Corners (n, 6) rad of a way from `start` to `end`, straight between them, or None when none was found.

    `ranges` are the least and the greatest joint angles (6,); `free` says whether the arm may stand there.
    """
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

    def looked(state: Any) -> bool:
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
    free: Callable[[Joints], bool],
    start: Joints,
    end: Joints,
    box: tuple[NDArray[np.float64], NDArray[np.float64]],
    effort: Effort,
) -> NDArray[np.float64] | None:
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
