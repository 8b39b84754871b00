"""`cell bench cycle`: where the time of a job goes, motion by motion, beside the least that each could take.

A batch on the virtual clock, in a cell that is calibrated, its time stamps as well. Its first part is cold, one in its
middle repeated. What a device did comes from the run's record, as the report's drawing shows it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cell import Cell
from cell.config.cell_config import CellConfig, load_config, mounted
from cell.config.job import Job, load_job
from cell.devices.devices import Devices
from cell.motion.collision import tool_bodies
from cell.motion.kinematics import JointLimits
from cell.motion.trajectory import PointSpeed, carried_points, plan_joint
from cell.procedures.arm.moves import Mover
from cell.run.report.page.course import Activity, activities, idle
from drivers.errors import RefusedError

PARTS = 4
MOVED = ("vehicle", "arm")
"""Devices of which the least time is told: what else is done takes as long as the job or a device's limits have it."""


def cycle(job: str, seed: int, level: str, done: Callable[[str], None]) -> dict[str, object]:
    """Both parts: their motions, and what their time is made of, s."""
    config, loaded = load_config(None), load_job(job)[0]
    result: dict[str, object] = {}
    with Cell.open(sim="all", seed=seed, level=level, clock="virtual", job=job) as cell:
        limits = LeastTimes.of(cell.devices, config, loaded)
        # As an engineer does before parts are made.
        cell.calibrate(job=job)
        cell.time_stamps(job=job)
        done("calibrated")
        batch = cell.run_batch(job, PARTS)
        if len(batch.runs) < PARTS:
            raise RefusedError(f"the batch ended early: {batch.reason}. Try another --seed")
        # One that is corrected takes longer.
        repeated = min(batch.runs[1:-1], key=lambda run: float(run.report["cell_s"]))
        for name, run in (("cold", batch.runs[0]), ("repeated", repeated)):
            done(f"{name}: {run.outcome}")
            result[name] = {"outcome": run.outcome, **told(activities(run.folder), float(run.report["cell_s"]), limits)}
    return result


@dataclass(frozen=True)
class LeastTimes:
    """The least time that a motion takes: straight, from rest to rest, at the limits, with nothing in the way."""

    joints: JointLimits
    points: PointSpeed
    vehicle_speed: float

    @classmethod
    def of(cls, devices: Devices, config: CellConfig, job: Job) -> "LeastTimes":
        """With the job's part in the claw."""
        mover = Mover(devices.arm, devices.clock, config, None)
        tool = tool_bodies(job.grasp.size, job.grasp.flange_from_part.se3(), mounted(config))
        points = PointSpeed(mover.kinematics, carried_points(tool), config.arm.max_tool_speed)
        return cls(mover.kinematics.limits, points, job.approach.speed)

    def __call__(self, activity: Activity) -> float:
        """In s; of a device whose states are not told, what it took."""
        if activity.first is None or activity.last is None:
            return activity.end - activity.begin
        if activity.device == "vehicle":
            (x, y), (there_x, there_y) = (
                np.array([state["x"], state["y"]]) for state in (activity.first, activity.last)
            )
            return math.hypot(there_x - x, there_y - y) / self.vehicle_speed
        start, end = (np.array(state["joints"], dtype=np.float64) for state in (activity.first, activity.last))
        return plan_joint(start, end, self.joints, points=self.points).duration


def told(found: Sequence[Activity], length: float, least: Callable[[Activity], float]) -> dict[str, object]:
    """What the `found` activities of a run of `length` s add up to, and each of the motions beside its least time."""
    motions = [
        {
            "device": activity.device, "from_s": round(activity.begin, 2),
            "lasts_s": round(activity.end - activity.begin, 2), "least_s": round(least(activity), 2),
            "meanwhile": ", ".join(dict.fromkeys(other.device for other in found if _beside(activity, other))),
        }
        for activity in sorted(found, key=lambda one: one.begin)
        if activity.device in MOVED
    ]  # fmt: skip
    lit = sum(activity.end - activity.begin for activity in found if activity.device == "laser")
    lasts, leasts = (sum(float(str(one[key])) for one in motions) for key in ("lasts_s", "least_s"))
    return {
        "length_s": round(length, 2), "arm_and_vehicle_s": round(lasts, 2), "their_least_s": round(leasts, 2),
        "laser_lit_s": round(lit, 2),
        "nothing_done_s": round(sum(end - begin for begin, end in idle(found, length)), 2),
        "of_the_least": round(length / max(leasts + lit, 1e-9), 3), "motions": motions,
    }  # fmt: skip


def _beside(activity: Activity, other: Activity) -> bool:
    return other.device != activity.device and min(activity.end, other.end) - max(activity.begin, other.begin) > 0.05
