"""`report.json` and the picture of a run: what happened, what was placed, and in a simulated cell how true it is.

Every key is told in `docs/reference/report.md`. The report alone asks for the world's truth: no step has a way to it.
"""

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from cell.base.storage import sealed, strict, write_json
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.measure.geometry.poses import difference, from_matrix, to_ur, transform
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.frame_store import FrameStore
from cell.procedures.part_error import draws, part_points, placed_points, point_covariances, stated_bound, through
from cell.procedures.steps.reconstruct import Reconstruction
from cell.procedures.steps.verify_nest import where_seen
from cell.procedures.sweep.stored_sweep import SweepRecord
from cell.run.folder import REPORT, release, timeless, when
from cell.run.report.evidence import last_frames, measured, refusal, seen_placed, textures_of
from drivers.interfaces import Vector
from statemachine.runner import Event, RunResult
from statemachine.step import summary_of

SENSOR_POINTS = 1000

log = logging.getLogger(__name__)


class TruthRecorder:
    """Listens to a run and notes the truth right after the sweep, when the scanned surface was where it was scanned."""

    def __init__(self, ask: Callable[[], dict[str, Any]]) -> None:
        """`ask()` gives the whole truth; see `sim_backends.world.world`."""
        self.ask = ask
        self.at_sweep: dict[str, object] | None = None

    def __call__(self, event: Event) -> None:
        """Take an event of the runner."""
        if event.kind == "step_done" and event.step == "laser_sweep":
            self.at_sweep = self.ask()


@dataclass(frozen=True, eq=False)
class FinishedJob:
    """A job's run that has come to its `result`, from which its report is made.

    `repeatability` is the arm's covariance (6, 6), m² and rad². `info` are facts for the report. `started` is a time of
    the wall. `witness` recorded the truth of a simulated cell.
    """

    folder: Path
    config: CellConfig
    job: Job
    nominal: NominalSurface
    repeatability: Vector
    result: RunResult
    info: dict[str, object]
    started: float
    witness: TruthRecorder | None
    frames: FrameStore

    def report(self) -> dict[str, Any]:
        """Everything about the run as JSON-ready data; also `report.json` and `picture.png` in its folder. Written
        before the comparison with the truth and the picture as well: what goes wrong with those is told in it."""
        report: dict[str, Any] = self._of_the_run()
        self._add_place(report)
        report["measured"] = measured(self.result, self.job, None, report["place_bound_95"])
        if self.frames.failure is not None:
            report["frames_missing"] = self.frames.failure
        _write(self.folder, sealed(strict(timeless(report))))
        if self.witness is not None:
            try:
                self._add_truth(report, self.witness)
            except Exception as error:
                report["truth_missing"] = f"{type(error).__name__}: {error}"
        report["measured"] = measured(self.result, self.job, report["truth"], report["place_bound_95"])
        textures = {}
        try:
            textures = textures_of(self.result, self.nominal, self.job.surface.area)
        except Exception as error:
            report["texture_missing"] = f"{type(error).__name__}: {error}"
        for name, texture in textures.items():
            if name:
                report["scan"]["areas"].append({"name": name, **texture.as_dict()})
            else:
                report["scan"]["texture"] = texture.as_dict()
            report["measured"] += [number.as_dict() for number in texture.measured(name or "the surface")]
        if self.config.cell.picture:
            self._draw(report)
        report = sealed(strict(timeless(report)))
        _write(self.folder, report)
        return report

    def _draw(self, report: dict[str, object]) -> None:
        """The run's picture; why there is none is told in the `report`."""
        picture = self.folder / "picture.png"
        try:
            # Drawing is the slowest thing to load, and a command that jogs or stops the cell does not draw.
            from cell.run.report.pictures import draw_run

            draw_run(picture, self.job, self.nominal, result=self.result, report=report, frames=self.frames)
        except Exception as error:
            report["picture_missing"] = f"{type(error).__name__}: {error}"
            # Half of one shows nothing, and `cell` would point at it.
            with suppress(OSError):
                picture.unlink()

    def _of_the_run(self) -> dict[str, object]:
        """What every run has, in the order of the file; what is not known yet is None."""
        ended, result, place = time.time(), self.result, where_seen(self.job).place
        made = result.results.get("reconstruct")
        return {
            "run": self.folder.name, "kind": "job", "version": release(),
            "outcome": result.outcome.value, "reason": result.reason, "code": result.code,
            "started": when(self.started), "ended": when(ended), "wall_s": round(ended - self.started, 2),
            **self.info,
            "steps": _steps(result), "faults": _faults(result),
            "refusal": refusal(result, self.folder, self.frames),
            "last_frames": last_frames(result, self.frames),
            "place_pose": None,
            "place_pose_units": {"translation_mm": "mm", "rotation_vector_rad": "rad"},
            "place_sigma": None,
            "place_sigma_units": {"translation_mm": "mm", "rotation_mrad": "mrad"},
            "place_bound_95": None,
            "tolerance": {"translation_mm": 1e3 * place.tolerance, "rotation_mrad": 1e3 * place.tolerance_angle},
            "measured": [],
            "assumed_noise": {"level": self.info["level"], "sigmas": _configured_noise(self.config)},
            "scan": {**made.summary(), "texture": None, "areas": []} if isinstance(made, Reconstruction) else None,
            "truth": None,
        }  # fmt: skip

    def _add_place(self, report: dict[str, object]) -> None:
        """The place pose, where one was inverted."""
        pose = self.result.results.get("invert_pose")
        if not isinstance(pose, PlacePose):
            return
        # Where something creeps, the part went elsewhere than where the sweep saw the place.
        pose = getattr(self.result.results.get("place"), "pose", None) or pose
        report["place_pose"] = _pose(pose, self.job)
        sigma = _mm_mrad(np.sqrt(np.diag(pose.covariance)), digits=5)
        report["place_sigma"] = {"frame": "arm base, about the surface's origin", **sigma}
        if (seen := seen_placed(self.result)) is not None:
            # What was seen says more than what was stated before.
            frame = "surface" if not self.job.unloads else "arm base"
            report["place_bound_95"] = {"frame": frame, "unit": "mm", **seen.bound}
            return
        covariance = self.job.grasp.covariance
        report["place_bound_95"] = stated_bound(self.job, self.nominal, pose, self.repeatability, covariance)

    def _add_truth(self, report: dict[str, Any], witness: TruthRecorder) -> None:
        """The comparison with the simulated world; raises when that does not answer any more."""
        job, nominal, result = self.job, self.nominal, self.result
        now = witness.ask()
        report["assumed_noise"]["sigmas"] = now["assumed_noise"]
        report["end_state"] = {
            key: now[key] for key in ("laser_on", "vehicle", "arm", "rail_moving", "part", "collisions")
        }
        sweep, made, pose = (result.results.get(name) for name in ("laser_sweep", "reconstruct", "invert_pose"))
        if isinstance(pose, PlacePose) and witness.at_sweep is not None:
            # Arm base axes, at the sweep; also where the place was refused.
            sought = "base_from_part" if job.unloads else "base_from_surface"
            report["pose_error"] = _mm_mrad(difference(pose.base_from_surface, pose_of(witness.at_sweep, sought)))
            report["pose_error_units"] = {"translation_mm": "mm", "rotation_mrad": "mrad"}
        if report["outcome"] not in ("placed", "misplaced") or not isinstance(pose, PlacePose):
            return
        if job.unloads:
            if (nested := seen_placed(result)) is not None:
                report["nest_error"] = _mm_mrad(
                    difference(nested.seen.surface_from_part, pose_of(now, "base_from_part"))
                )
            return
        truth = place_error(job, nominal, now)
        assert isinstance(sweep, SweepRecord)
        truth["bound_mm"] = expected_error(
            job, nominal, pose, sweep.base_from_flange, sweeps=len(sweep.swaths), configured=self.repeatability,
            truth=now,
        )  # fmt: skip
        if isinstance(made, Reconstruction) and witness.at_sweep is not None:
            truth["sensor_mm"] = sensor_error(made.cloud, nominal, witness.at_sweep)
        report["truth"] = truth
        if (seen := seen_placed(result)) is not None:
            truth["seen_error"] = _mm_mrad(difference(seen.seen.surface_from_part, pose_of(now, "surface_from_part")))


def _write(folder: Path, report: dict[str, object]) -> None:
    """The report as a file; a disk that takes none of it does not hide how the run ended."""
    try:
        write_json(folder / REPORT, report)
    except Exception as error:
        report["report_missing"] = f"{type(error).__name__}: {error}"
        log.error("the report could not be written: %s", error)


def _steps(result: RunResult) -> list[dict[str, object]]:
    return [
        {
            "name": step.name, "state": step.state, "duration_s": round(step.duration_s, 3),
            "wall_s": round(step.wall_s, 3), "retries": step.retries,
            "result": summary_of(result.results.get(step.name)),
        }
        for step in result.steps
    ]  # fmt: skip


def _faults(result: RunResult) -> list[dict[str, object]]:
    names = ("step", "attempt", "code", "reason", "remedy")
    return [{"at": when(fault.at), **{name: getattr(fault, name) for name in names}} for fault in result.faults]


def _pose(pose: PlacePose, job: Job) -> dict[str, object]:
    base_from_part = pose.base_from_surface * job.place.surface_from_part.se3()
    values = to_ur(base_from_part)
    return {
        "frame": "base_from_part",
        "translation_mm": [round(1e3 * float(v), 5) for v in values[:3]],
        "rotation_vector_rad": [round(float(v), 8) for v in values[3:]],
    }


def _configured_noise(config: CellConfig) -> dict[str, object]:
    arm = config.arm
    return {
        "arm_repeatability": {
            "of": "arm, each axis, each time it settles", "sigma": 1e3 * arm.repeatability, "unit": "mm",
        },
        "arm_repeatability_angle": {
            "of": "arm's angles, each time it settles", "sigma": 1e3 * arm.repeatability_angle, "unit": "mrad",
        },
    }  # fmt: skip


def _mm_mrad(motion: Vector, digits: int = 4) -> dict[str, list[float]]:
    """Six numbers of a motion, m and rad, as the report has them."""
    return {
        "translation_mm": [round(1e3 * float(v), digits) for v in motion[:3]],
        "rotation_mrad": [round(1e3 * float(v), digits) for v in motion[3:]],
    }


def pose_of(truth: dict[str, Any], name: str) -> pin.SE3:
    """A pose of the truth by its name."""
    return from_matrix(truth["poses"][name])


def sensor_error(cloud: Cloud, nominal: NominalSurface, truth: dict[str, object]) -> dict[str, float] | None:
    """Distance of 1000 cloud points from the true surface, the arm's and the hand-eye's error included; mm."""
    lines, rows = cloud.valid.nonzero()
    points = transform(pose_of(truth, "base_from_surface").inverse(), cloud.points[lines, rows])
    deviations = nominal.deviations(points)
    deviations = deviations[np.isfinite(deviations)]
    if len(deviations) < SENSOR_POINTS:
        return None
    distance = 1e3 * np.abs(deviations[np.linspace(0, len(deviations) - 1, SENSOR_POINTS).astype(int)])
    return {"mean": float(distance.mean()), "p85": float(np.percentile(distance, 85))}


def place_error(job: Job, nominal: NominalSurface, truth: dict[str, object]) -> dict[str, object]:
    """How far the part's 45 points ended from where they belong on the true surface, in the surface's axes, mm."""
    points = part_points(nominal)
    ended = transform(pose_of(truth, "surface_from_part"), points)
    error = 1e3 * (ended - transform(job.place.surface_from_part.se3(), points))
    distance = np.linalg.norm(error, axis=1)
    columns = {"x": np.abs(error[:, 0]), "y": np.abs(error[:, 1]), "z": np.abs(error[:, 2]), "d": distance}
    return {
        "points": len(points),
        "error_mm": {name: {"mean": float(v.mean()), "max": float(v.max())} for name, v in columns.items()},
        "d_p95": float(np.percentile(distance, 95)),
    }


def expected_error(
    job: Job, nominal: NominalSurface, pose: PlacePose, base_from_sweep_flange: pin.SE3, sweeps: int,
    configured: Vector, truth: dict[str, Any],
) -> float:  # fmt: skip
    """Mean D in mm over the 45 points to expect from the world's assumed noise.

    Stripe, rail and calibration as the pose's covariance states them; the arm's repeatability, once for each of the
    `sweeps`, whose mean counts, and once for placing, as the world assumes it instead of the `configured` (6, 6) that
    the covariance was stated with. The arm's kinematic error is in it as configured, which is part of the pose's
    covariance.
    """
    noise = truth["assumed_noise"]
    radial, angle = (noise[name]["sigma"] for name in ("arm_repeatability", "arm_repeatability_rotation"))
    assumed = np.diag([radial**2 / 3] * 3 + [angle**2] * 3)
    points, _ = placed_points(job, nominal, pose)
    covariance = point_covariances(job, nominal, pose, pose.covariance, assumed)
    covariance = covariance + through(points - base_from_sweep_flange.translation, (assumed - configured) / sweeps)
    return float(1e3 * np.linalg.norm(draws(covariance), axis=-1).mean())
