"""`cell bench accuracy`: the whole job on many simulated cells, its errors beside their bounds and limits.

A world a seed and level, each calibrated and run by the product's own runner on the virtual clock, spread over the
cores; at every level the acceptance tests of the trade on the first seed's scan head.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.stats import chi2

from cell.apps.qualify.intervals import Share
from cell.config.cell_config import CellConfig, load_config
from cell.config.job import Job, load_job
from cell.measure.geometry.poses import difference, transform
from cell.measure.inversion import NominalSurface, PlacePose
from cell.procedures.part_error import part_points
from cell.run.report.report import pose_of
from drivers.interfaces import Vector
from lab.bench.acceptance.campaign import acceptance
from lab.bench.job.expected import expect
from lab.bench.job.scan_errors import COVERED, by_pose, own_base, scan_errors, surface_at_middle
from lab.bench.job.whole_job import JobRecord, job_and_surface, run_whole_job
from lab.bench.over_cores import Done, over_cores
from sim_backends.world.levels import assumed_noise

LIMITS: dict[str, dict[str, float]] = {
    "sensor_scan_mm": {"mean": 0.06, "p85": 0.08},
    "arm_base_mm": {"mean": 0.10, "max": 0.20},
    "placement_mm": {"mean": 0.12, "p95": 0.25},
    "tilt_mrad": {"max": 1.5},
}
"""What is to be reached at level nominal."""

WANTED = (0.90, 0.98)
"""True coverage that a stated 95 % ellipsoid may have."""


def campaign(seeds: Sequence[int], levels: Sequence[str], job: str, done: Done, workers: int = 0) -> dict[str, Any]:
    """Run every seed at every level and sum up; `done` is told in words of each run and acceptance test that ended.
    `workers` processes, by default one a core. Figures of one level stand at the top as well, that of the first."""
    load_job(job)
    worlds = [(one_run, job, seed, level) for level in levels for seed in seeds]
    tests = [(acceptance, seeds[0], level) for level in levels]
    made = over_cores(
        [*worlds, *tests], workers,
        lambda one: done(f"seed {one['seed']} {one['level']}: {one.get('outcome', 'acceptance measured')}"),
    )  # fmt: skip
    by_level = {}
    for number, level in enumerate(levels):
        runs = made[number * len(seeds) : (number + 1) * len(seeds)]
        by_level[level] = summed_up(runs, level) | {"acceptance": made[len(worlds) + number]}
    return {"job": job, "seeds": list(seeds), **by_level[levels[0]], "levels": by_level}


def one_run(job: str, seed: int, level: str) -> dict[str, Any]:
    """Calibrate and run one world; its errors in mm and mrad, JSON-ready."""
    config, (loaded, nominal) = load_config(None), job_and_surface(job)
    return figures(run_whole_job(config, loaded, nominal, seed, level), config, loaded, nominal)


def figures(record: JobRecord, config: CellConfig, job: Job, nominal: NominalSurface) -> dict[str, Any]:
    """The errors of one record, lists of single distances in mm; parts that it did not come to are missing."""
    made: dict[str, Any] = {
        "seed": record.seed, "level": record.level, "outcome": record.outcome, "reason": record.reason,
        "stage": record.stage,
    }  # fmt: skip
    if record.calibration is not None:
        made["chi2_calibration"] = record.calibration.scan.quality.chi2_per_dof
        made["chi2_target"] = record.calibration.target.quality.chi2_per_dof
    pose = record.results.get("invert_pose")
    if not isinstance(pose, PlacePose):
        return made
    assert record.at_sweep is not None and record.kinematic is not None
    scan = scan_errors(record, nominal, record.kinematic)
    assert scan is not None
    made |= {name: _mm(getattr(scan, name)) for name in ("scan", "aligned", "own", "absolute")}
    made["bound"] = {name: 1e3 * mean for name, mean in expect(record, config, job, nominal).items()}
    made["chi2_registration"] = pose.chi2_per_dof
    true = own_base(record) * surface_at_middle(record)
    off = difference(pose.base_from_surface, true)
    points = part_points(nominal)
    apart = transform(pose.base_from_surface, points) - transform(true, points)
    arms = by_pose(transform(true, points) - true.translation)
    stated = arms @ pose.covariance @ arms.transpose(0, 2, 1)
    made["covered"] = {
        "place_pose": bool(off @ np.linalg.solve(pose.covariance, off) <= chi2.ppf(COVERED, 6)),
        "part_points": float(
            np.mean(np.einsum("ni,nij,nj->n", apart, np.linalg.inv(stated), apart) <= chi2.ppf(COVERED, 3))
        ),
        "cloud_points": float(scan.inside.mean()),
    }
    if record.outcome == "placed":
        made |= _placed(record, job, points)
    return made


def _placed(record: JobRecord, job: Job, points: Vector) -> dict[str, Any]:
    assert record.at_end is not None
    ended, wanted = pose_of(record.at_end, "surface_from_part"), job.place.surface_from_part.se3()
    distance = np.linalg.norm(transform(ended, points) - transform(wanted, points), axis=1)
    turned = ended.rotation @ wanted.rotation.T
    axis = turned @ np.array([0.0, 0.0, 1.0])
    within = distance.max() <= job.place.tolerance and np.linalg.norm(pin.log3(turned)) <= job.place.tolerance_angle
    return {
        "placement": _mm(distance),
        "tilt": 1e3 * float(np.arctan2(np.hypot(axis[0], axis[1]), axis[2])),
        "within_tolerance": bool(within),
    }


def summed_up(runs: Sequence[dict[str, Any]], level: str) -> dict[str, Any]:
    """All runs of one level together: distances pooled over runs, bounds averaged; None where no run came to it."""
    placed = [run for run in runs if "placement" in run]
    measured = [run for run in runs if "scan" in run]
    result: dict[str, Any] = {
        "level": level,
        "runs": len(runs),
        "sensor_scan_mm": {
            "mean": _mean(measured, "scan"),
            "p85": _percentile(measured, "scan", 85),
            "bound": _bound(measured, "sensor"),
            "aligned_mean": _mean(measured, "aligned"),
        },
        "arm_base_mm": {
            "mean": _mean(measured, "own"),
            "max": _percentile(measured, "own", 100),
            "bound": _bound(measured, "own"),
            "absolute_mean": _mean(measured, "absolute"),
            "absolute_bound": _bound(measured, "absolute"),
        },
        "placement_mm": {
            "mean": _mean(placed, "placement"),
            "p95": _percentile(placed, "placement", 95),
            "max": _percentile(placed, "placement", 100),
            "bound": _bound(placed, "placing"),
        },
        "tilt_mrad": {"mean": _mean(placed, "tilt"), "max": _percentile(placed, "tilt", 100)},
        "coverage_95": _covered(measured, "part_points"),
        "coverage": {name: _covered(measured, name) for name in ("place_pose", "part_points", "cloud_points")},
        "coverage_between": {name: _between(measured, name) for name in ("place_pose", "part_points")},
        "chi2_per_dof": {
            name: _average([run[f"chi2_{name}"] for run in runs if f"chi2_{name}" in run])
            for name in ("calibration", "target", "registration")
        },
        "outcomes": _outcomes(runs),
        "assumed_noise": assumed_noise(level),
    }
    if level == "nominal":
        result["limits"] = {**LIMITS, "coverage_95": {"low": WANTED[0], "high": WANTED[1]}}
        result["within_limits"] = _within(result)
    result["per_run"] = [_short(run) for run in runs]
    return result


def _outcomes(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    reasons = Counter(f"{run['stage']}: {run['reason']}" for run in runs if run["outcome"] != "placed")
    return {
        "placed_within_tolerance": sum(run.get("within_tolerance") is True for run in runs),
        "placed_outside_tolerance": sum(run.get("within_tolerance") is False for run in runs),
        **{name: sum(run["outcome"] == name for run in runs) for name in ("refused", "faulted", "aborted")},
        "reasons": dict(reasons.most_common()),
    }


def _within(result: dict[str, Any]) -> bool:
    """Whether every limit is kept; a figure that is missing keeps none."""
    kept = []
    for key, limits in LIMITS.items():
        kept += [result[key][name] is not None and result[key][name] <= limit for name, limit in limits.items()]
    between = result["coverage_between"]["part_points"]
    # By its interval: few worlds explain much.
    return all(kept) and between is not None and between[0] <= WANTED[1] and between[1] >= WANTED[0]


def _short(run: dict[str, Any]) -> dict[str, Any]:
    lists = ("scan", "aligned", "own", "absolute", "placement")
    return {name: float(np.mean(value)) if name in lists else value for name, value in run.items()}


def _pool(runs: Sequence[dict[str, Any]], name: str) -> Vector:
    return np.concatenate([np.atleast_1d(run[name]) for run in runs]) if runs else np.zeros(0)


def _mean(runs: Sequence[dict[str, Any]], name: str) -> float | None:
    return _average(_pool(runs, name))


def _percentile(runs: Sequence[dict[str, Any]], name: str, share: float) -> float | None:
    pooled = _pool(runs, name)
    return float(np.percentile(pooled, share)) if len(pooled) else None


def _bound(runs: Sequence[dict[str, Any]], name: str) -> float | None:
    return _average([run["bound"][name] for run in runs])


def _covered(runs: Sequence[dict[str, Any]], name: str) -> float | None:
    return _average([run["covered"][name] for run in runs])


def interval(count: int, of: int) -> tuple[float, float]:
    """Both ends of the 95 % interval of a share."""
    share = Share(count, of)
    return share.low, share.high


def _between(runs: Sequence[dict[str, Any]], name: str) -> tuple[float, float] | None:
    return interval(sum(run["covered"][name] for run in runs), len(runs)) if runs else None


def _average(values: Sequence[float] | Vector) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _mm(distances: Vector) -> list[float]:
    return [round(1e3 * float(d), 5) for d in distances]
