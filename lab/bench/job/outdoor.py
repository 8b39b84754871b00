"""`cell bench outdoor`: up to which illuminance the cell places, with a band-pass filter and without one.

Each world is calibrated under a roof, stands for an hour, and does its job in the open, by the product's own runner on
the virtual clock. Beside it stands how far the line's centres scatter in drawn pictures of a textured plane under the
same light: as they are, and less a picture without the laser, which a sweep would take 0.1 mm farther on.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.config.cell_config import CellConfig, load_config
from cell.devices.simulated.direct import VirtualCell
from cell.measure.vision.stripe.extract import extract
from cell.procedures.ambient import WANTED_DN
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.make import FilterConfig
from lab.bench.job.accuracy import figures
from lab.bench.job.whole_job import JobRecord, job_and_surface, run_whole_job
from lab.bench.over_cores import Done, over_cores
from sim_backends.optics.camera import CameraOptics, sensor
from sim_backends.optics.daylight import ROOMS_PER_KLX, laser_passed, share_passed
from sim_backends.optics.lighting import AMBIENT_RATE
from sim_backends.optics.render import expected_image
from sim_backends.optics.scene import LaserOptics, Light, PlaneInstance
from sim_backends.world.cameras import SCAN_TRANSMISSION, SURFACE_ALBEDO

KLX = (0, 5, 10, 20, 40, 60, 80, 100)
BAND = {"centre": "660 nm", "width": "20 nm", "transmission": 0.9}
PHOTO_S = 0.1
"""Exposure of the scan camera's photographs behind the filter, which leaves little of a room's light."""
STOOD_S = 3600.0
WISH_S = 0.002


def campaign(
    job: str, seeds: Sequence[int], illuminances: Sequence[int], done: Done, workers: int = 0
) -> dict[str, Any]:
    """Each illuminance, klx, on every seed, with the filter and without it; `done` is told of each; JSON-ready."""
    asked = [(one_world, job, seed, tuple(illuminances), band) for seed in seeds for band in (True, False)]
    worlds = over_cores(asked, workers, lambda made: done(f"{made[0]['row']} and more, seed {made[0]['seed']}"))
    runs = [run for world in worlds for run in world]
    rows = {}
    for klx in illuminances:
        for band in (True, False):
            name = row_of(klx, band)
            rows[name] = summed_up([run for run in runs if run["row"] == name]) | scatter(klx, band)
    return {"job": job, "seeds": list(seeds), "rows": rows}


def row_of(klx: int, band: bool) -> str:
    """How a row is called."""
    return f"{klx} klx, {'filter' if band else 'no filter'}"


def configured(band: bool) -> CellConfig:
    """The shipped cell, with the filter or without."""
    config = load_config(None)
    camera = config.scan_camera.model_copy(
        update={"filter": FilterConfig.model_validate(BAND), "photo_exposure": PHOTO_S} if band else {}
    )
    return config.model_copy(update={"scan_camera": camera})


def one_world(job: str, seed: int, illuminances: Sequence[int], band: bool) -> list[dict[str, Any]]:
    """One world under each light, calibrated once: errors in mm, and the exposure of the sweep in ms; JSON-ready."""
    config, (loaded, nominal) = configured(band), job_and_surface(job)
    made, calibrated = [], None
    for klx in illuminances:
        record = run_whole_job(
            config, loaded, nominal, seed, "outdoor", calibrated=calibrated, stood=STOOD_S,
            changed=partial(_shine, klx=float(klx)),
        )  # fmt: skip
        made.append(told(record, figures(record, config, loaded, nominal), row_of(klx, band)))
        calibrated = record if record.calibration is not None else None
    return made


def _shine(cell: VirtualCell, klx: float) -> None:
    scene = cell.world.scene
    cell.world.remake(replace(scene, workshop=replace(scene.workshop, klx=klx)), cell.world.station)


def told(record: JobRecord, made: dict[str, Any], row: str) -> dict[str, Any]:
    """What of one job the page has; `made` are its `figures`."""
    sweep = record.results.get("laser_sweep")
    return {
        "row": row, **{key: made[key] for key in ("seed", "outcome", "reason", "stage")},
        "mean": float(np.mean(made["placement"])) if "placement" in made else None,
        "largest": float(np.max(made["placement"])) if "placement" in made else None,
        "inside": made["covered"]["place_pose"] if "covered" in made else None,
        "within_tolerance": made.get("within_tolerance"),
        "exposure": 1e3 * sweep.middle.exposure if isinstance(sweep, SweepRecord) else None,
    }  # fmt: skip


def summed_up(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """All worlds of one row; "figure" says it in words."""
    placed = [run for run in runs if run["outcome"] == "placed"]
    inside = sum(bool(run["inside"]) for run in placed)
    exposures = sorted(run["exposure"] for run in runs if run["exposure"] is not None)
    text = f"{len(placed)} of {len(runs)} placed"
    if placed:
        mean, largest = np.mean([run["mean"] for run in placed]), max(run["largest"] for run in placed)
        text += f", mean D {mean:.3f}, largest {largest:.3f} mm, {inside} inside"
    if exposures:
        text += f"; exposure {exposures[0]:.2f} to {exposures[-1]:.2f} ms"
    by_light = sum("ambient light" in run["reason"] for run in runs)
    if len(placed) < len(runs):
        text += f"; {by_light} refused for ambient light, {len(runs) - len(placed) - by_light} otherwise"
    wrong = sum(run["within_tolerance"] is False for run in runs)
    return {"figure": text, "placed": len(placed), "wrong": wrong, "runs": list(runs)}


def scatter(klx: int, band: bool) -> dict[str, float | None]:
    """RMS in px of the line's centres about a straight line, as it is and by difference; None where too few show it."""
    passed = FilterConfig.model_validate(BAND)
    of_band = passed.centre, passed.width, passed.transmission
    optics = CameraOptics(640, 480, 1667.0, 1667.0, 319.5, 239.5, transmission=SCAN_TRANSMISSION)
    laser = LaserOptics()
    if band:
        optics = replace(optics, transmission=share_passed(of_band))
        laser = replace(laser, brightness=laser.brightness * laser_passed(of_band))
    light = Light(1.0 + klx * ROOMS_PER_KLX)
    exposure = min(WISH_S, WANTED_DN / (AMBIENT_RATE * light.level * optics.transmission * SURFACE_ALBEDO))
    pose, rng = np.eye(4), np.random.default_rng(klx)
    pose[2, 3] = 0.130
    scene = [PlaneInstance(pose, (0.5, 0.5), SURFACE_ALBEDO)]
    line = expected_image(optics, scene, laser, exposure, rng, light=light)
    ambient = expected_image(optics, scene, None, exposure, rng, light=light)
    grain = cv2.GaussianBlur(rng.standard_normal(line.shape).astype(np.float32), (0, 0), 4.0)
    grain = 1.0 + 0.1 * grain / grain.std()
    lit, dark = sensor(line + ambient * (grain - 1.0), optics, rng), sensor(ambient * np.roll(grain, 1, 1), optics, rng)
    return {"px": _about_line(lit, None), "px_by_difference": _about_line(lit, dark)}


def _about_line(lit: NDArray[np.uint8], dark: NDArray[np.uint8] | None) -> float | None:
    line = extract(lit, dark)
    if line.valid.mean() < 0.5:
        return None
    off = line.centres[line.rows] - np.polyval(np.polyfit(line.rows, line.centres[line.rows], 1), line.rows)
    return float(np.sqrt(np.mean(off**2)))
