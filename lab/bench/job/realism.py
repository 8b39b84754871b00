"""`cell bench realism`: what the workshop's effects do to the product, each alone and all together.

A world is calibrated, stands for a while, in which laser and cameras warm up, and does its job, by the product's own
runner on the virtual clock. It is well when what was placed lies within what was stated of it, or when the job was
refused with the effect's name; it is ill when something wrong was told with confidence.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from cell.apps.qualify.intervals import Share
from cell.config.cell_config import load_config
from cell.config.job import Job, load_job
from cell.measure.geometry.poses import difference
from cell.measure.inversion import PlacePose
from cell.procedures.part_error import part_covariance
from cell.run.report.report import pose_of
from lab.bench.job.accuracy import WANTED, figures, interval
from lab.bench.job.scan_errors import COVERED
from lab.bench.job.whole_job import JobRecord, job_and_surface, run_whole_job
from lab.bench.over_cores import Done, over_cores
from sim_backends.world.levels import Effects, assumed_noise

STOOD_S = 3600.0
"""Between calibration and job."""
PLANE = np.array([0, 1, 5])
"""Of a part's pose: x, y and the turn about z. Contact decides over the others."""
ALONE, TOGETHER = "nominal", "workshop"
WORDS: dict[str, tuple[str, ...]] = {
    "factory_arm": ("kinematics",),
    "joint_harmonics": ("harmonics",),
    "path_memory": ("repeatability",),
    "sag": ("sags",),
    "rocking": ("vehicle rocks",),
    "sheet_bow": ("bowed",),
    "laser_pointing": ("laser points",),
    "camera_warm_up": ("warmed",),
    "grasp": ("grasp",),
    "late_stamps": ("come so late",),
    "rolling_shutter": ("shutter",),
    "texture": ("texture",),
    "gloss": ("gloss",),
    "dust": ("dust",),
    "sheet_ends": ("sheet ends",),
    "sunlight": ("ambient light",),
    "droop": ("carriage",),
    "oil": ("oil, ",),
}
"""A refusal with one of these words names the effect: words that no other refusal has."""


def campaign(effects: Sequence[str], seeds: Sequence[int], job: str, done: Done, workers: int = 0) -> dict[str, Any]:
    """Every effect alone on every seed, then all together if "workshop" is among `effects`; `done` is told of each."""
    load_job(job)
    runs = over_cores(
        [(one_run, job, seed, effect) for effect in effects for seed in seeds], workers,
        lambda run: done(f"{run['effect']}, seed {run['seed']}: {run['verdict']}"),
    )  # fmt: skip
    by_effect = {name: summed_up(name, [run for run in runs if run["effect"] == name]) for name in effects}
    return {"job": job, "seeds": list(seeds), "effects": by_effect, "placed": pooled(by_effect)}


def level_of(effect: str) -> str:
    """The world's level with this effect: "nominal" and "workshop" are themselves."""
    return effect if effect in (ALONE, TOGETHER) else f"{ALONE}+{effect}"


def one_run(job: str, seed: int, effect: str) -> dict[str, Any]:
    """One world with one effect: its errors in mm and mrad and whether they lie within what was stated; JSON-ready."""
    config, (loaded, nominal) = load_config(None), job_and_surface(job)
    record = run_whole_job(config, loaded, nominal, seed, level_of(effect), stood=STOOD_S)
    made = figures(record, config, loaded, nominal)
    run: dict[str, Any] = {key: made[key] for key in ("seed", "outcome", "reason", "stage")}
    run["effect"] = effect
    run["pose_inside"] = made["covered"]["place_pose"] if "covered" in made else None
    run["arm_base_mm"] = float(np.mean(made["own"])) if "own" in made else None
    run["placement_mm"] = float(np.mean(made["placement"])) if "placement" in made else None
    run["within_tolerance"] = made.get("within_tolerance")
    run["flags"] = flags_of(record)
    run["part_inside"] = part_inside(record, loaded)
    return run | {"verdict": verdict(run)}


def flags_of(record: JobRecord) -> list[str]:
    """What calibration and job said by themselves of what is not as it should be."""
    flags = [] if record.calibration is None else list(record.calibration.scan.notes)
    return flags + [note for result in record.results.values() for note in getattr(result, "notes", ())]


def part_inside(record: JobRecord, job: Job) -> bool | None:
    """Whether the part ended within what was stated of it, in the surface's plane; None of one that was not placed."""
    pose = record.results.get("invert_pose")
    if record.outcome != "placed" or not isinstance(pose, PlacePose) or record.placing is None:
        return None
    assert record.at_end is not None
    off = difference(pose_of(record.at_end, "surface_from_part"), job.place.surface_from_part.se3())[PLANE]
    stated = part_covariance(job, pose, record.placing)[np.ix_(PLANE, PLANE)]
    return bool(off @ np.linalg.solve(stated, off) <= chi2.ppf(COVERED, len(PLANE)))


def verdict(run: dict[str, Any]) -> str:
    """Inside what was stated; or named: refused by the effect's name; or refused otherwise; or outside. What was placed
    outside is outside, whatever was noted: a note says what the measurements have allowed for."""
    if run["outcome"] == "placed":
        return "inside" if run["pose_inside"] and run["part_inside"] else "outside"
    names = Effects.names() if run["effect"] == TOGETHER else (run["effect"],)
    words = [word for name in names for word in WORDS.get(name, ())]
    return "named" if any(word in run["reason"] for word in words) else "refused"


def summed_up(effect: str, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """All worlds of one effect together; shares of those that came to it, None where none did."""
    count = {name: sum(run["verdict"] == name for run in runs) for name in ("inside", "named", "refused", "outside")}
    noise = assumed_noise(level_of(effect))
    return {
        "size": noise.get(effect),
        "worlds": len(runs),
        **count,
        "between": interval(count["inside"] + count["named"], len(runs)),
        "pose_inside": _mean(runs, "pose_inside"),
        "part_inside": _mean(runs, "part_inside"),
        "outside_tolerance": sum(run["within_tolerance"] is False for run in runs),
        "arm_base_mm": _mean(runs, "arm_base_mm"),
        "placement_mm": _mean(runs, "placement_mm"),
        "reasons": sorted({run["reason"] for run in runs if run["reason"]}),
        "flags": sorted({flag for run in runs for flag in run["flags"]}),
        "runs": list(runs),
    }


def pooled(by_effect: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """What was placed in all effects together. The effects share their seeds, so this is no more than a hint."""
    placed = [run for entry in by_effect.values() for run in entry["runs"] if run["outcome"] == "placed"]
    inside = sum(run["verdict"] == "inside" for run in placed)
    return {"worlds": len(placed), "inside": inside, "between": interval(inside, len(placed))}


def is_well(entry: dict[str, Any]) -> bool:
    """Whether true shares of 90 % and more explain how many of an effect's worlds told nothing wrong and were not
    refused without its name, and none was placed outside the tolerance."""
    good = int(entry["inside"]) + int(entry["named"])
    return Share(good, int(entry["worlds"])).high >= WANTED[0] and not entry["outside_tolerance"]


def _mean(runs: Sequence[dict[str, Any]], name: str) -> float | None:
    known = [run[name] for run in runs if run[name] is not None]
    return float(np.mean(known)) if known else None
