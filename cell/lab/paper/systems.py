"""Ours beside the systems that the paper cites: the same task, in simulation, with our estimators, over many seeds.

Theirs are hardware figures from their makers or papers; ours are simulated under stated noise. The table compares what
such a head could do, not two instruments.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.geometry.poses import from_axes, from_parts, perturbed, transform
from cell.lab.bench.over_cores import Progress, run_all
from cell.lab.paper.cited import SYSTEMS, CitedSystem, cited
from cell.lab.paper.rig import RigSpec, TrueHead, arm_error, draw_head, observe, sweep
from cell.lab.paper.shapes import DENT_RADIUS, dented_plate, relief
from cell.lab.paper.solved import Solved, aligned, expected_length, in_scan_frame, point_covariances, solve
from cell.lab.paper.stitching import STATIONS, STEP, stitch
from cell.reconstruction import ProfileBuilder
from cell.vision import StripeStream
from sim_backends.optics import MeshInstance, render

Array = NDArray[np.float64]

LINES = 60
POINTS = 1000
DEPTH_STOPS = 5
POSES = 5
TIMED_FRAMES, TIMED_ROUNDS = 8, 12
FACING = np.diag([1.0, -1.0, -1.0])


def systems(seeds: Iterable[int], workers: int = 0, progress: Progress | None = None) -> dict[str, Any]:
    """Each cited system beside ours: error over the seeds in mm, what noise lets one expect, and points per second."""
    wanted = list(seeds)
    runs = run_all(one_system, [(system.key, seed) for system in SYSTEMS for seed in wanted], workers, progress)
    rows = []
    for index, system in enumerate(SYSTEMS):
        own = runs[index * len(wanted) : (index + 1) * len(wanted)]
        rows.append(
            {
                "system": system.name,
                "reference": system.reference,
                "theirs": {
                    "headline": system.headline,
                    "mm": system.claim_mm,
                    "points_per_s": system.claim_points_per_s,
                    "measured": "on hardware, by a rule that the paper does not state",
                },
                "ours": {
                    "task": system.task,
                    "mean_mm": float(np.mean([run["mean"] for run in own])),
                    "p95_mm": float(np.mean([run["p95"] for run in own])),
                    "worst_seed_p95_mm": max(run["p95"] for run in own),
                    "expected_mean_mm": float(np.mean([run["expected"] for run in own])),
                    "points_per_s": None if system.claim_points_per_s is None else points_per_second(system.spec),
                    "measured": "simulated",
                },
                "remark": system.remark,
                "head": system.spec.as_dict(),
                "noise": system.spec.noise.as_dict(),
            }
        )
    return {"note": "ours simulated, theirs measured on hardware", "seeds": len(wanted), "systems": rows}


def one_system(item: tuple[str, int]) -> dict[str, Any]:
    """Mean and 95th percentile of the error of one head of a system, and the mean to expect, mm."""
    key, seed = item
    system = cited(key)
    rng = np.random.default_rng([seed, len(key), 15])
    head = draw_head(system.spec, rng)
    solved = solve(system.spec, observe(system.spec, head, rng))
    error, expected = _measure(system, head, solved, rng)
    return {"mean": 1e3 * float(error.mean()), "p95": 1e3 * float(np.percentile(error, 95)), "expected": 1e3 * expected}


def _measure(system: CitedSystem, head: TrueHead, solved: Solved, rng: np.random.Generator) -> tuple[Array, float]:
    """Lengths (n,) of the points' errors in m by the system's task, and the mean length to expect."""
    if system.task == "dent":
        return _dent(system.spec, head, solved, rng)
    if system.task == "arm_base":
        return _arm_base(system.spec, head, solved, rng)
    if system.task == "form":
        return _form(system.spec, head, solved, rng)
    spec = system.spec
    width = 0.85 * spec.height * spec.pixel / spec.focal * spec.meeting
    mesh = relief(spec.travel + STEP * (STATIONS - 1), width, 80_000)
    found, truth = stitch(spec, head, in_scan_frame(solved.joint), mesh, rng)
    return np.linalg.norm(aligned(found, truth), axis=1), _expected_form(spec, solved, *_scan(spec, head, rng)[1:])


def _scan(spec: RigSpec, head: TrueHead, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """True points (n, 3), pixels (n, 2) and rail readings (n,) of reliefs at stops over the depths, scan frame."""
    parts: list[tuple[Array, Array, Array]] = []
    for depth in np.linspace(*spec.depths, DEPTH_STOPS):
        width = 0.85 * spec.height * spec.pixel / spec.focal * depth
        pose = from_parts((0.5 * spec.travel, 0.0, depth), FACING)
        # A quarter of the field tall at most: what is nearer or farther than the depths is not asked for.
        mesh = relief(0.8 * spec.travel, width)
        swept = sweep(spec, head, mesh, pose, np.linspace(0.0, spec.travel, LINES), rng)
        lines, rows = np.nonzero(np.isfinite(swept.centres))
        chosen = rng.permutation(len(lines))[: POINTS // DEPTH_STOPS]
        lines, rows = lines[chosen], rows[chosen]
        pixels = np.column_stack([swept.centres[lines, rows], rows.astype(np.float64)])
        parts.append((swept.truth[lines, rows], pixels, swept.readings[lines]))
    truth, pixels, readings = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return truth, pixels, readings


def _form(spec: RigSpec, head: TrueHead, solved: Solved, rng: np.random.Generator) -> tuple[Array, float]:
    truth, pixels, readings = _scan(spec, head, rng)
    found, _ = in_scan_frame(solved.joint).solve(pixels, readings)
    return np.linalg.norm(aligned(found, truth), axis=1), _expected_form(spec, solved, pixels, readings)


def _expected_form(spec: RigSpec, solved: Solved, pixels: Array, readings: Array) -> float:
    """Mean error to expect after one rigid motion: what the calibration's covariance still bends, and the noise."""
    geometry = in_scan_frame(solved.joint)
    points, by_pixel = geometry.solve(pixels, readings)
    bent = [
        aligned(in_scan_frame(variant).solve(pixels, readings)[0], points) for variant in solved.calibration.variants()
    ]
    along = np.broadcast_to(geometry.rail_direction, points.shape)
    columns = np.stack([*bent, by_pixel[:, :, 0] * spec.noise.stripe, along * spec.noise.rail], axis=2)
    return expected_length(columns @ columns.transpose(0, 2, 1))


def _arm_base(spec: RigSpec, head: TrueHead, solved: Solved, rng: np.random.Generator) -> tuple[Array, float]:
    truth, pixels, readings = _scan(spec, head, rng)
    inner, _ = solved.joint.solve(pixels, readings)
    noise = spec.noise
    covariance = np.diag([noise.arm**2 / 3] * 3 + [noise.arm_turn**2] * 3)
    own = point_covariances(spec, solved.joint, solved.calibration.variants(), pixels, readings)
    errors, covariances = [], []
    for part in np.array_split(rng.permutation(len(truth)), POSES):
        reported = from_axes((0.5, 0.1, 0.4), x=(0, 1, 0), z=(0, 0, -1))
        reported = perturbed(reported, 0.2 * rng.standard_normal(6))
        true = perturbed(reported, arm_error(noise, rng))
        there = transform(true * head.flange_from_camera, truth[part])
        errors.append(transform(reported, inner[part]) - there)
        by_pose = np.stack([np.hstack([np.eye(3), -pin.skew(arm)]) for arm in there - true.translation])
        covariances.append(
            reported.rotation @ own[part] @ reported.rotation.T + by_pose @ covariance @ by_pose.transpose(0, 2, 1)
        )
    return np.linalg.norm(np.concatenate(errors), axis=1), expected_length(np.concatenate(covariances))


def _dent(spec: RigSpec, head: TrueHead, solved: Solved, rng: np.random.Generator) -> tuple[Array, float]:
    """Depth errors of single points on the floor of a dent, against the line through its surroundings."""
    plane, rail = head.laser, 0.5 * spec.travel
    pose = from_parts((rail, 0.0, float(np.mean(spec.depths))), FACING)
    # The carriage stands where the light plane passes through the dent's middle.
    normal = np.asarray(plane.normal)
    at = float((normal @ pose.translation - plane.distance) / (normal @ head.rail_direction))
    errors, sigmas = [], []
    for off in np.linspace(-1e-3, 1e-3, 9):
        swept = sweep(spec, head, dented_plate(), pose, np.array([at + off]), rng)
        rows = np.flatnonzero(np.isfinite(swept.centres[0]))
        pixels = np.column_stack([swept.centres[0, rows], rows.astype(np.float64)])
        found, by_pixel = in_scan_frame(solved.joint).solve(pixels, np.full(len(rows), at + off))
        truth = swept.truth[0, rows]
        aside = np.abs(truth[:, 1] - pose.translation[1])
        floor, around = aside < 0.5 * DENT_RADIUS, aside > 1.7 * DENT_RADIUS
        errors.append(np.abs(_below(found, floor, around) - _below(truth, floor, around)))
        sigmas.append(by_pixel[floor, 2, 0] * spec.noise.stripe)
    sigma = float(np.sqrt(np.mean(np.concatenate(sigmas) ** 2)))
    # The mean absolute value of a Gaussian variable.
    return np.concatenate(errors), sigma * float(np.sqrt(2 / np.pi))


def _below(points: Array, floor: NDArray[np.bool_], around: NDArray[np.bool_]) -> Array:
    """Distances (m,) in z of the floor's points from the straight line through the surroundings."""
    line = np.polyfit(points[around, 1], points[around, 2], 1)
    return np.asarray(points[floor, 2] - np.polyval(line, points[floor, 1]), dtype=np.float64)


def points_per_second(spec: RigSpec) -> float:
    """Points per second of processor time, as on one core, from frame to cloud: extraction and triangulation."""
    rng = np.random.default_rng(13)
    head = draw_head(spec, rng)
    width = 0.85 * spec.height * spec.pixel / spec.focal * spec.meeting
    mesh = relief(0.8 * spec.travel, width)
    frames = []
    for reading in np.linspace(0.3, 0.7, TIMED_FRAMES) * spec.travel:
        pose = from_parts((0.5 * spec.travel - reading, 0.0, spec.meeting), FACING).homogeneous
        frames.append(render(head.optics, [MeshInstance(pose, mesh)], head.laser, 0.003, rng))
    geometry = in_scan_frame(spec.nominal())
    _collect(spec, geometry, frames)
    rates = []
    for _ in range(TIMED_ROUNDS):
        start = time.process_time()
        points = _collect(spec, geometry, frames)
        rates.append(points / (time.process_time() - start))
    return float(np.median(rates))


def _collect(spec: RigSpec, geometry: Any, frames: list[NDArray[np.uint8]]) -> int:
    builder, stripes = ProfileBuilder(geometry, len(frames)), StripeStream()
    return sum(builder.add(stripes.extract(frame), 1e-3 * k, spec.noise.rail) for k, frame in enumerate(frames))
