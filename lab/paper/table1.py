"""Section 5.2 and Table 1 in simulation: 100 and 1000 points, 45 points in 5 segments, before and after optimisation.

Observations come from the simulator's optics with stated noise, the estimators are the product's own. The paper's
figures were measured on its hardware; ours are simulated and say so.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.poses import perturbed, transform
from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.reconstruction.cloud import Cloud
from lab.bench.calibration.world import profile_of
from lab.bench.over_cores import Done, over_cores
from lab.bench.reconstruction.scenes import swept
from lab.paper.rig import (
    RigSpec,
    Solved,
    Sweep,
    aligned,
    arm_error,
    draw_head,
    expected_length,
    from_axes,
    in_scan_frame,
    observe,
    point_covariances,
    solve,
    sweep,
)
from sim_backends.optics import Mesh
from sim_backends.world.bodies.surfaces import mesh as surface_mesh

TABLE_1_OPTIMISED: dict[str, tuple[float, float]] = {
    "x": (0.8415, 1.1258), "y": (0.4324, 0.7849), "z": (0.9577, 1.1574), "d": (1.4361, 1.9587),
}  # fmt: skip
"""Mean and maximum in mm, 45 points, the paper's system after its optimisation."""

TABLE_1_HANDSCAN: dict[str, tuple[float, float]] = {
    "x": (0.2214, 0.5126), "y": (0.2452, 0.5849), "z": (0.3026, 0.7548), "d": (0.5487, 1.0244),
}  # fmt: skip
"""Mean and maximum in mm, 45 points, the hand-held scanner that the paper compares with."""

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

SPEC = RigSpec()
LINES = 140
OUTLIER_SHARE = 0.02
SEGMENTS, PER_SEGMENT = 5, 9
POINT_COUNTS = (100, 1000)
PAPER_LIMIT_MM = 0.54
PAPER: dict[str, float | int | str] = {
    "points_below_0.54_mm": "> 85 %",
    "mean_change_mm": 0.67,
    "outliers": 3,
    "largest_outlier_mm": 0.85,
}
"""What section 5.2 states of its 1000 points."""
Mask = NDArray[np.bool_]

NEAR_MM, FAR_MM = (0.3, 0.85), (1.0, 6.0)
STREAK_ROWS = (4, 10)


def table1(seeds: Iterable[int], done: Done) -> dict[str, Any]:
    """Both tests over the seeds, summarised beside the paper's figures. All lengths in mm."""
    runs = over_cores([(one_seed, seed) for seed in seeds], ended=lambda run: done("heads"))
    ways = ("nominal", "staged", "joint")
    return {
        "note": "simulated; the paper's figures were measured on its hardware and are quoted as printed",
        "seeds": len(runs),
        "assumed_noise": SPEC.noise.as_dict(),
        "assumed_head": SPEC.as_dict(),
        "section_5_2": {
            str(count): {
                way: {
                    key: float(np.mean([run["points"][str(count)][way][key] for run in runs]))
                    for key in runs[0]["points"][str(count)][way]
                }
                for way in ways
            }
            for count in POINT_COUNTS
        },
        "bound_scan_frame_mm": float(np.mean([run["bound_scan_frame"] for run in runs])),
        "mean_change_mm": _spread([run["mean_change"] for run in runs]),
        "outliers": {key: float(np.mean([run["outliers"][key] for run in runs])) for key in runs[0]["outliers"]},
        "least_outlier_recall": float(min(run["outliers"]["recall"] for run in runs)),
        "least_outlier_precision": float(min(run["outliers"]["precision"] for run in runs)),
        "table_1": {
            way: {
                axis: {
                    "mean": float(np.mean([run["table"][way][axis]["mean"] for run in runs])),
                    "max": float(np.mean([run["table"][way][axis]["max"] for run in runs])),
                    "worst": float(np.max([run["table"][way][axis]["max"] for run in runs])),
                }
                for axis in ("x", "y", "z", "d")
            }
            for way in ways
        },
        "bound_arm_base_mm": float(np.mean([run["bound_arm_base"] for run in runs])),
        "chi2_per_dof": float(np.mean([run["chi2_per_dof"] for run in runs])),
        "paper": {
            "section_5_2": PAPER,
            "table_1": {
                name: {axis: {"mean": mean, "max": top} for axis, (mean, top) in table.items()}
                for name, table in (("optimised", TABLE_1_OPTIMISED), ("handscan", TABLE_1_HANDSCAN))
            },
            "flaws": [
                "the largest D_XYZ, 1.9587 mm, is more than the largest X, Y and Z allow together (1.7951 mm)",
                "over 85 % below 0.54 mm cannot be the same test as a mean D of 1.4361 mm",
            ],
        },
    }


def one_seed(seed: int) -> dict[str, Any]:
    """One head: drawn, calibrated, a sweep of the pot's relief, and 45 points in the arm's base. Lengths in mm."""
    rng = np.random.default_rng([seed, 51])
    head = draw_head(SPEC, rng)
    solved = solve(SPEC, observe(SPEC, head, rng))
    swept = sweep(SPEC, head, _relief(), over(SPEC), np.linspace(0.01, 0.09, LINES), rng)
    spoiled = spoil(swept, SPEC, OUTLIER_SHARE, rng)
    cloud = reconstruct(swept, spoiled.centres, in_scan_frame(solved.joint), SPEC)
    lines, rows = np.nonzero(np.isfinite(swept.centres))
    chosen = rng.permutation(len(lines))[: max(POINT_COUNTS)]
    lines, rows = lines[chosen], rows[chosen]
    found = {name: _measured(in_scan_frame(way), swept, lines, rows) for name, way in solved.ways().items()}
    truth = swept.truth[lines, rows]
    pixels, rail = _readings(swept, lines, rows)
    variants = [in_scan_frame(v) for v in solved.calibration.variants()]
    covariances = point_covariances(SPEC, in_scan_frame(solved.joint), variants, pixels, rail)
    return {
        "points": {
            str(count): {name: _deviations(points[:count], truth[:count]) for name, points in found.items()}
            for count in POINT_COUNTS
        },
        "mean_change": 1e3 * float(np.linalg.norm(found["nominal"] - found["joint"], axis=1).mean()),
        "bound_scan_frame": 1e3 * expected_length(covariances),
        "outliers": found_outliers(cloud, spoiled),
        "chi2_per_dof": solved.calibration.quality.chi2_per_dof,
        **_forty_five(solved, head.flange_from_camera, swept, rng),
    }


def over(spec: RigSpec) -> pin.SE3:
    """The relief below the middle of the rail's travel, its z axis up at the camera."""
    middle = float(np.mean(spec.depths))
    return from_axes((0.5 * spec.travel, 0.0, middle), x=(1, 0, 0), z=(0, 0, -1))


def _relief() -> Mesh:
    made = surface_mesh("pot", 20_000, False)
    return Mesh(made.vertices, made.triangles)


def _readings(swept: Sweep, lines: Indices, rows: Indices) -> tuple[Array, Array]:
    return np.column_stack([swept.centres[lines, rows], rows.astype(np.float64)]), swept.readings[lines]


def _measured(geometry: ScanGeometry, swept: Sweep, lines: Indices, rows: Indices) -> Array:
    return geometry.solve(*_readings(swept, lines, rows))[0]


def _deviations(found: Array, truth: Array) -> dict[str, float]:
    distance = 1e3 * np.linalg.norm(found - truth, axis=1)
    return {
        "mean": float(distance.mean()),
        "max": float(distance.max()),
        "p85": float(np.percentile(distance, 85)),
        "share_below_0.54": float(np.mean(distance < PAPER_LIMIT_MM)),
        "aligned_mean": 1e3 * float(np.linalg.norm(aligned(found, truth), axis=1).mean()),
    }


def _forty_five(solved: Solved, flange_from_camera: pin.SE3, swept: Sweep, rng: np.random.Generator) -> dict[str, Any]:
    """Table 1: nine points at each of five stops along a path, in the arm's base, at the flange poses as reported."""
    errors: dict[str, list[Array]] = {name: [] for name in solved.ways()}
    covariances = []
    noise = SPEC.noise
    arm = np.diag([noise.arm**2 / 3] * 3 + [noise.arm_angle**2] * 3)
    variants = solved.calibration.variants()
    lines, rows = np.nonzero(np.isfinite(swept.centres))
    parts = np.array_split(np.arange(len(lines)), SEGMENTS)
    for k, part in enumerate(parts):
        reported = from_axes((0.45 + 0.06 * k, -0.12 + 0.06 * k, 0.35), x=(0, 1, 0), z=(0, 0, -1))
        reported = perturbed(reported, np.concatenate([np.zeros(3), 0.1 * rng.standard_normal(3)]))
        true = perturbed(reported, arm_error(noise, rng))
        own = part[np.linspace(0, len(part) - 1, PER_SEGMENT).astype(int)]
        truth = transform(true * flange_from_camera, swept.truth[lines[own], rows[own]])
        for name, way in solved.ways().items():
            errors[name].append(transform(reported, _measured(way, swept, lines[own], rows[own])) - truth)
        inner = point_covariances(SPEC, solved.joint, variants, *_readings(swept, lines[own], rows[own]))
        arms = truth - true.translation
        by_pose = np.stack([np.hstack([np.eye(3), -pin.skew(a)]) for a in arms])
        turned = reported.rotation @ inner @ reported.rotation.T
        covariances.append(turned + by_pose @ arm @ by_pose.transpose(0, 2, 1))
    return {
        "table": {name: _axes(1e3 * np.abs(np.concatenate(parts))) for name, parts in errors.items()},
        "bound_arm_base": 1e3 * expected_length(np.concatenate(covariances)),
    }


def _axes(error: Array) -> dict[str, dict[str, float]]:
    columns = {"x": error[:, 0], "y": error[:, 1], "z": error[:, 2], "d": np.linalg.norm(error, axis=1)}
    return {axis: {"mean": float(v.mean()), "max": float(v.max())} for axis, v in columns.items()}


def _spread(values: Sequence[float]) -> dict[str, float]:
    """Mean, median, 95th percentile and largest of values over seeds."""
    mean, median, p95, largest = np.mean(values), *np.percentile(values, (50, 95)), max(values)
    return {"mean": float(mean), "median": float(median), "p95": float(p95), "max": float(largest)}


@dataclass(frozen=True, eq=False)
class Spoiled:
    """A sweep's centres with outliers in them; masks (lines, rows) of where, one for each kind."""

    centres: Array
    kinds: dict[str, Mask]

    @property
    def any(self) -> Mask:
        """Where anything was put in."""
        return np.asarray(np.logical_or.reduce(list(self.kinds.values())), dtype=np.bool_)


def spoil(sweep: Sweep, spec: RigSpec, share: float, rng: np.random.Generator) -> Spoiled:
    """Replace `share` of the points by outliers: half near, a quarter far, a quarter in streaks along the stripe."""
    centres = sweep.centres.copy()
    lines, rows = np.nonzero(np.isfinite(centres))
    total = round(share * len(lines))
    # Δu of one millimetre of depth: the closed form's ∂Z/∂x' = Z²/(l f), in pixels.
    px_per_mm = 1e-3 * spec.baseline * spec.focal / (spec.meeting**2 * spec.pixel)
    kinds = {name: np.zeros(centres.shape, dtype=np.bool_) for name in ("near", "far", "streak")}
    single = rng.choice(len(lines), 3 * total // 4, replace=False)
    near = len(single) * 2 // 3
    for name, chosen, (low, high) in (("near", single[:near], NEAR_MM), ("far", single[near:], FAR_MM)):
        kinds[name][lines[chosen], rows[chosen]] = True
        off = rng.uniform(low, high, len(chosen)) * rng.choice([-1.0, 1.0], len(chosen))
        centres[lines[chosen], rows[chosen]] += px_per_mm * off
    left = total - len(single)
    while left > 0:
        k = int(rng.integers(len(lines)))
        length = min(left, int(rng.integers(STREAK_ROWS[0], STREAK_ROWS[1] + 1)))
        line, first = int(lines[k]), int(rows[k])
        where = slice(first, first + length)
        fresh = np.isfinite(centres[line, where]) & ~kinds["near"][line, where] & ~kinds["far"][line, where]
        fresh &= ~kinds["streak"][line, where]
        if fresh.all() and len(fresh) == length:
            off = rng.uniform(*FAR_MM) * rng.choice([-1.0, 1.0])
            centres[line, where] += px_per_mm * (off + rng.normal(0, 0.02, length))
            kinds["streak"][line, where] = True
            left -= length
    return Spoiled(centres, kinds)


def reconstruct(sweep: Sweep, centres: Array, geometry: ScanGeometry, spec: RigSpec) -> Cloud:
    """The product's own reconstruction of the centres, in the frame of `geometry`, with its outlier filter."""
    profiles = (
        (profile_of(columns, spec.noise.stripe, 2.0), float(reading))
        for columns, reading in zip(centres, sweep.readings, strict=True)
    )
    return swept(geometry, profiles, spec.noise.rail, pin.SE3.Identity())


def found_outliers(cloud: Cloud, spoiled: Spoiled) -> dict[str, float | int]:
    """Recall of each kind and of all, precision, and the counts behind them."""
    rejected, put = cloud.rejected, spoiled.any
    hits = int((rejected & put).sum())
    figures: dict[str, float | int] = {
        "injected": int(put.sum()),
        "rejected": int(rejected.sum()),
        "recall": hits / max(1, int(put.sum())),
        "precision": hits / max(1, int(rejected.sum())),
    }
    for name, mask in spoiled.kinds.items():
        figures[f"recall_{name}"] = int((rejected & mask).sum()) / max(1, int(mask.sum()))
    return figures
