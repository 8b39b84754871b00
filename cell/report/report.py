"""`report.json` and the picture of a run: what happened, what was placed, and in a simulated cell how true it is."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from cell.config import CellConfig
from cell.geometry.poses import to_ur, transform
from cell.inversion import NominalSurface, PlacePose
from cell.job import Job
from cell.report.truth import Witness, ask_truth, expected_error, place_error, pose_error, sensor_error
from cell.runs import REPORT, write_json
from cell.steps.laser_sweep import SweepRecord
from cell.steps.reconstruct import Reconstruction
from drivers.interfaces import Image, Vector
from statemachine.runner import RunResult


def make_report(
    folder: Path,
    config: CellConfig,
    job: Job,
    nominal: NominalSurface,
    repeatability: Vector,
    result: RunResult,
    info: dict[str, Any],
    started: float,
    witness: Witness | None,
    frames_missing: str | None,
) -> dict[str, Any]:
    """Everything about a run as JSON-ready data; also `report.json` and `picture.png` in its folder.

    Written before the comparison with the truth and the picture as well: what goes wrong with those is told in it.
    """
    pose = result.results.get("invert_pose")
    report: dict[str, Any] = {
        "run": folder.name,
        "outcome": result.outcome.value,
        "reason": result.reason,
        "code": result.code,
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(started)),
        "wall_s": round(time.time() - started, 2),
        **info,
        "steps": [
            {"name": step.name, "state": step.state, "duration_s": round(step.duration_s, 3), "retries": step.retries}
            for step in result.steps
        ],
        "place_pose": None,
        "place_sigma": None,
        "assumed_noise": {"level": info["level"], "sigmas": _configured_noise(config)},
        "scan": None,
        "truth": None,
    }
    made = result.results.get("reconstruct")
    if isinstance(made, Reconstruction):
        report["scan"] = made.summary()
    if isinstance(pose, PlacePose):
        report["place_pose"] = _pose(pose, job)
        report["place_sigma"] = _sigma(pose)
    if frames_missing is not None:
        report["frames_missing"] = frames_missing
    write_json(folder / REPORT, report)
    if witness is not None:
        try:
            _add_truth(report, config, job, nominal, repeatability, result, witness)
        except Exception as error:
            report["truth_missing"] = f"{type(error).__name__}: {error}"
    try:
        _draw(folder, job, nominal, result, report)
    except Exception as error:
        report["picture_missing"] = f"{type(error).__name__}: {error}"
    write_json(folder / REPORT, report)
    return report


def _pose(pose: PlacePose, job: Job) -> dict[str, Any]:
    base_from_part = pose.base_from_surface * job.place.surface_from_part.se3()
    values = to_ur(base_from_part)
    return {
        "frame": "base_from_part",
        "translation_mm": [round(1e3 * float(v), 5) for v in values[:3]],
        "rotation_vector_rad": [round(float(v), 8) for v in values[3:]],
    }


def _sigma(pose: PlacePose) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(pose.covariance))
    return {
        "frame": "arm base, about the surface's origin",
        "translation_mm": [round(1e3 * float(v), 5) for v in sigma[:3]],
        "rotation_mrad": [round(1e3 * float(v), 5) for v in sigma[3:]],
    }


def _configured_noise(config: CellConfig) -> dict[str, Any]:
    arm = config.arm
    return {
        "arm_repeatability": {
            "of": "arm, each axis, each time it settles", "sigma": 1e3 * arm.repeatability, "unit": "mm",
        },
        "arm_repeatability_angle": {
            "of": "arm's angles, each time it settles", "sigma": 1e3 * arm.repeatability_angle, "unit": "mrad",
        },
    }  # fmt: skip


def _add_truth(
    report: dict[str, Any],
    config: CellConfig,
    job: Job,
    nominal: NominalSurface,
    repeatability: Vector,
    result: RunResult,
    witness: Witness,
) -> None:
    """The comparison with the simulated world; raises when that does not answer any more."""
    now = ask_truth(config.cell.truth)
    report["assumed_noise"]["sigmas"] = now["assumed_noise"]
    report["end_state"] = {key: now[key] for key in ("laser_on", "vehicle", "arm", "rail_moving", "part")}
    sweep, made, pose = (result.results.get(name) for name in ("laser_sweep", "reconstruct", "invert_pose"))
    if isinstance(pose, PlacePose) and witness.at_sweep is not None:
        report["pose_error"] = pose_error(pose, witness.at_sweep)
    if report["outcome"] != "placed" or not isinstance(pose, PlacePose):
        return
    report["truth"] = place_error(job, nominal, now)
    assert isinstance(sweep, SweepRecord)
    report["truth"]["bound_mm"] = expected_error(
        job, nominal, pose, sweep.base_from_flange, len(sweep.swaths), repeatability, now
    )
    if isinstance(made, Reconstruction) and witness.at_sweep is not None:
        report["truth"]["sensor_mm"] = sensor_error(made.cloud, nominal, witness.at_sweep)


def _draw(folder: Path, job: Job, nominal: NominalSurface, result: RunResult, report: dict[str, Any]) -> None:
    # Drawing is the slowest thing to load, and a command that jogs or stops the cell does not draw.
    from cell.report.pictures import run_picture

    stripe: tuple[Image, Vector, Vector] | None = None
    cloud: tuple[Vector, Vector] | None = None
    sweep, made, pose = (result.results.get(name) for name in ("laser_sweep", "reconstruct", "invert_pose"))
    if isinstance(sweep, SweepRecord):
        profile = sweep.middle_profile
        stripe = (sweep.middle.image, profile.rows.astype(float), profile.centres[profile.rows])
    if isinstance(made, Reconstruction) and isinstance(pose, PlacePose):
        lines, rows = made.cloud.valid.nonzero()
        points = transform(pose.base_from_surface.inverse(), made.cloud.points[lines, rows])
        deviations = nominal.deviations(points)
        on_surface = np.isfinite(deviations)
        cloud = (points[on_surface], deviations[on_surface])
    title = f"run {report['run']}: job {job.job.name}, {report['outcome']}"
    if report["simulated"]:
        title += f" · simulated, seed {report['seed']}, level {report['level']}"
    seams = (report["scan"] or {}).get("seams", ())
    run_picture(folder / "picture.png", stripe=stripe, cloud=cloud, truth=report["truth"], title=title, seams=seams)
