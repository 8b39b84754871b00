"""`cell bench placed`: what is seen of placed parts, against where they truly lie, under effects that nobody told of.

The jobs' part covers the middle of its surface. An effect is well where the true error of every part that
was placed lies below the stated bound.
"""

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.stats import chi2

from cell.config.cell_config import load_config
from cell.config.job import Job
from cell.measure.geometry.poses import difference
from cell.measure.inversion import NominalSurface
from cell.procedures.placed_part import LIKELY, PlacedPart
from cell.run.report.report import place_error, pose_of
from drivers.errors import ConfigError
from lab.bench.job.part_effects import EFFECTS, PartEffect
from lab.bench.job.part_jobs import MIDDLE, job_with_part
from lab.bench.job.scan_errors import COVERED
from lab.bench.job.whole_job import JobRecord, job_and_surface, run_whole_job
from lab.bench.over_cores import Done, over_cores

Row = dict[str, Any]
"""JSON-ready, mm and mrad."""


def campaign(
    seeds: Sequence[int], level: str, job: str, names: Sequence[str], place: str, done: Done, workers: int = 0
) -> Row:
    """Run each effect of `names` on each seed; `place` are lines of the job's [place], `done` is told of each run.
    Raises `ConfigError` for an unknown effect."""
    if unknown := [name for name in names if name not in EFFECTS]:
        raise ConfigError(f"--effect {unknown[0]!r}: allowed are {', '.join(EFFECTS)}")

    def ended(rows: list[Row]) -> None:
        for row in rows:
            done(f"seed {row['seed']}, {row['effect']}: {row['outcome']}")

    worlds = over_cores([(one_world, job, seed, level, tuple(names), place) for seed in seeds], workers, ended)
    runs = [row for rows in zip(*worlds, strict=True) for row in rows]
    return {
        "job": job, "level": level, "seeds": len(seeds), "seen": _seen(runs), "placed_mm": _placed(runs),
        "effects": {name: _effect([run for run in runs if run["effect"] == name]) for name in names},
        "outside_bound": sum(run["outside"] for run in runs), "named": _named(runs), "runs": runs,
    }  # fmt: skip


def one_world(job: str, seed: int, level: str, names: Sequence[str], place: str) -> list[Row]:
    """The effects on one world, which is calibrated once."""
    rows: list[Row] = []
    calibrated: JobRecord | None = None
    for name in names:
        with tempfile.TemporaryDirectory(prefix="cell-placed-") as folder:
            file = job_with_part(Path(folder), job, verify="all", half=MIDDLE, also=place)
            record, row = one_part(file, seed, level, EFFECTS[name], calibrated)
        calibrated = calibrated or record
        rows.append({"seed": seed, "effect": name, **row})
    return rows


def one_part(
    file: Path, seed: int, level: str, effect: PartEffect, calibrated: JobRecord | None
) -> tuple[JobRecord, Row]:
    """A job with its part in one world under one effect, and how that part did."""
    job, nominal = job_and_surface(file)
    mesh = nominal.source
    assert mesh is not None
    record = run_whole_job(
        load_config(None), job, nominal, seed, level, calibrated=calibrated,
        changed=lambda cell: effect.put_into(cell.world, job, mesh, MIDDLE, file.parent),
    )  # fmt: skip
    return record, figures(record, nominal, job, effect)


def figures(record: JobRecord, nominal: NominalSurface, job: Job, effect: PartEffect) -> Row:
    """How one part was placed, seen and judged: mm and mrad."""
    assert record.at_end is not None
    made: Row = {"outcome": record.outcome, "stage": record.stage, "reason": record.reason, "outside": False}
    found = record.results.get("verify")
    said = record.reason
    if isinstance(found, PlacedPart):
        true = pose_of(record.at_end, "surface_from_part")
        error = difference(found.seen.surface_from_part, true)
        place: Row = place_error(job, nominal, record.at_end)
        said = "; ".join(found.notes)
        made |= {
            "true_mean": place["error_mm"]["d"]["mean"], "true_p95": place["d_p95"], "bound": found.bound["d"],
            "outside": place["d_p95"] > found.bound["d"], "before": [1e3 * off for off in found.before],
            "seen_off_by": 1e3 * float(np.linalg.norm(error[:3])),
            "seen_tilted_by": 1e3 * float(np.hypot(error[3], error[4])),
            "covered": bool(error @ np.linalg.solve(found.covariance, error) <= chi2.ppf(COVERED, 6)),
            "turned": 1e3 * float(np.linalg.norm(pin.log3(true.rotation))),
        }  # fmt: skip
    made["named"] = any(LIKELY[cause] in said for cause in effect.causes)
    return made


def _effect(runs: Sequence[Row]) -> Row:
    outcomes = sorted({run["outcome"] for run in runs})
    seen = [run for run in runs if "bound" in run]
    return {
        **{outcome: sum(run["outcome"] == outcome for run in runs) for outcome in outcomes},
        "true_p95_mm": _most(run["true_p95"] for run in seen), "bound_mm": _most(run["bound"] for run in seen),
        "outside": sum(run["outside"] for run in runs), "named": sum(run["named"] for run in runs),
    }  # fmt: skip


def _seen(runs: Sequence[Row]) -> Row:
    """How far from the truth the placed parts were seen."""
    seen = [run for run in runs if "bound" in run]
    if not seen:
        return {"parts": 0}
    off, tilted = (np.array([run[name] for run in seen]) for name in ("seen_off_by", "seen_tilted_by"))
    return {
        "parts": len(seen), "mean_mm": float(off.mean()), "p95_mm": float(np.percentile(off, 95)),
        "tilt_mean_mrad": float(tilted.mean()), "tilt_p95_mrad": float(np.percentile(tilted, 95)),
        "covered_95": float(np.mean([run["covered"] for run in seen])),
    }  # fmt: skip


def _placed(runs: Sequence[Row]) -> Row:
    """Where the parts came to lie, on average over their points, and in how many placings."""
    placed = [run for run in runs if run["outcome"] == "placed" and "true_mean" in run]
    if not placed:
        return {"parts": 0}
    mean = np.array([run["true_mean"] for run in placed])
    placings = [1 + len(run["before"]) for run in placed]
    return {
        "parts": len(placed), "mean": float(mean.mean()), "p95": float(np.percentile(mean, 95)),
        "placings": float(np.mean(placings)),
    }  # fmt: skip


def _named(runs: Sequence[Row]) -> float | None:
    """Of the effects that have a cause, share whose cause was told, or that were refused before the part went down."""
    caused = [run for run in runs if EFFECTS[run["effect"]].causes]
    return float(np.mean([run["named"] or run["outcome"] == "refused" for run in caused])) if caused else None


def _most(values: Iterable[float]) -> float | None:
    return max(values, default=None)
