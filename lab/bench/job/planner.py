"""`cell bench planner`: how many random pairs of free postures the product's planner joins, beside OMPL's own planners.

The arm stands at the station of a job with its part in the claw. A pair has a way where any of the planners found one;
one of them is given much more time than the others. Each way is looked at by samples, not by the planner's own check.
"""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ompl import base, geometric, util

from cell.check.reach import station_planner
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.measure.inversion.nominal import NominalSurface
from cell.motion.collision import CollisionError
from cell.motion.kinematics import Joints
from cell.motion.planning import Planner

MakePlanner = Callable[..., Any]
PEERS: dict[str, MakePlanner] = {
    "OMPL RRT-Connect": geometric.RRTConnect, "OMPL LBKPIECE": geometric.LBKPIECE1, "OMPL BIT*": geometric.BITstar,
}  # fmt: skip
"""As they come: their own range, their own resolution. A way of theirs may pass through a body between two looks."""
PEERS_S = 1.0
"""Processor time that a peer has for one pair."""
FINE_RAD = 0.01
"""Between two samples of a way, by which its least distance is told."""
SHARE, DISTANCE_MM = 0.995, 5.0
"""What the product's planner has to join of the pairs that have a way, and how far apart bodies stay."""
PRODUCT, LONG = "cell", "OMPL RRT-Connect, much longer"


@dataclass(frozen=True)
class Search:
    """What came of one planner and one pair: corners (n, 6) rad or None, and how long it took of one core, s."""

    way: NDArray[np.float64] | None
    took: float


def planner(job: str, count: int, seed: int, patience: float, done: Callable[[str], None]) -> dict[str, object]:
    """`count` pairs drawn with `seed`; a pair that no planner joins is searched for `patience` s of processor time."""
    loaded, mesh = load_job(job)
    surface = NominalSurface.load(mesh, loaded.surface.mesh_unit)
    joined = station_planner(loaded, load_config(None), surface.extent)
    drawn = np.random.default_rng(seed)
    rows: list[dict[str, Search]] = []
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed)
    for k in range(count):
        rows.append(_pair(joined, free_posture(joined, drawn), free_posture(joined, drawn), patience))
        done(f"pair {k + 1} of {count}")
    ways = [any(found.way is not None for found in row.values()) for row in rows]
    planners = [_figures(name, joined, rows, ways) for name in (PRODUCT, *PEERS)]
    own = planners[0]
    return {
        "pairs": count,
        "with_a_way": sum(ways),
        "planners": planners,
        "within_limits": own["of_those_with_a_way"] >= SHARE and own["least_distance_mm"] >= DISTANCE_MM,
    }


def free_posture(joined: Planner, drawn: np.random.Generator) -> Joints:
    """Joint angles (6,) rad within half a turn and the arm's limits, at which nothing touches."""
    low, high = np.maximum(joined.limits.lower, -np.pi), np.minimum(joined.limits.upper, np.pi)
    while True:
        joints = drawn.uniform(low, high)
        if joined.collisions.free(joints):
            return joints


def _pair(joined: Planner, start: Joints, end: Joints, patience: float) -> dict[str, Search]:
    began = time.process_time()
    try:
        way = joined.free(start, end).joints
    except CollisionError:
        way = None
    row = {PRODUCT: Search(way, time.process_time() - began)}
    row |= {name: by_ompl(make, joined, start, end, PEERS_S) for name, make in PEERS.items()}
    if all(found.way is None for found in row.values()):
        row[LONG] = by_ompl(geometric.RRTConnect, joined, start, end, patience)
    return row


def by_ompl(make: MakePlanner, joined: Planner, start: Joints, end: Joints, seconds: float) -> Search:
    """A search by one of OMPL's planners within the arm's whole limits, at most `seconds` of processor time."""
    space, bounds = base.RealVectorStateSpace(6), base.RealVectorBounds(6)
    for joint in range(6):
        bounds.setLow(joint, joined.limits.lower[joint])
        bounds.setHigh(joint, joined.limits.upper[joint])
    space.setBounds(bounds)
    info = base.SpaceInformation(space)
    info.setStateValidityChecker(lambda state: joined.collisions.free(_joints(state)))
    info.setup()
    problem, states = base.ProblemDefinition(info), []
    for joints in (start, end):
        states.append(info.allocState())
        for joint in range(6):
            states[-1][joint] = float(joints[joint])
    problem.setStartAndGoalStates(*states)
    search = make(info)
    search.setProblemDefinition(problem)
    search.setup()
    began = time.process_time()
    search.solve(base.PlannerTerminationCondition(lambda: time.process_time() - began > seconds))
    took = time.process_time() - began
    if not problem.hasExactSolution():
        return Search(None, took)
    return Search(np.array([_joints(state) for state in problem.getSolutionPath().getStates()]), took)


def _joints(state: Any) -> Joints:
    return np.array([state[joint] for joint in range(6)])


def _figures(name: str, joined: Planner, rows: Sequence[Mapping[str, Search]], ways: Sequence[bool]) -> dict[str, Any]:
    took = [row[name].took for row, has_way in zip(rows, ways, strict=True) if has_way]
    found = [row[name].way for row in rows]
    least = [least_distance(joined, way) for way in found if way is not None]
    return {
        "planner": name, "solved": len(least), "of_those_with_a_way": round(len(least) / max(1, sum(ways)), 4),
        "median_s": round(float(np.median(took)), 3), "p99_s": round(float(np.percentile(took, 99)), 3),
        "least_distance_mm": round(1e3 * min(least, default=np.nan), 2),
    }  # fmt: skip


def least_distance(joined: Planner, way: NDArray[np.float64]) -> float:
    """The least distance of any two bodies on a way (n, 6) rad, m, by samples; negative where they overlap."""
    fine = [way[:1]]
    for begin, end in itertools.pairwise(way):
        steps = max(1, int(np.ceil(np.abs(end - begin).max() / FINE_RAD)))
        fine.append(begin + (end - begin) * np.arange(1, steps + 1)[:, None] / steps)
    return min(float(joined.collisions.distances(joints).min()) for joints in np.vstack(fine))
