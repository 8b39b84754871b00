"""The campaign behind `cell bench calibration`: many heads calibrated from drawn observations, errors beside the bound.

Each seed draws a head and its noise. The product's own calibration solves it, and points are measured with both.
Where the scan frame lies is partly gauge, the arm's base is what placing feels. The bound is Cramér and Rao's: Fisher
information of the generator itself, without any derivative of the estimator. What the best calibration makes of the
very noise that was drawn is its linear estimate: so luck is told from loss.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import load_config
from cell.measure.calibration import ScanObservation
from cell.measure.calibration.solve.adjustment import Adjustment, shared_mask
from cell.measure.calibration.solve.joint import solve_joint, solve_staged, start_state
from cell.measure.calibration.solve.normal import tangents
from cell.measure.calibration.solve.results import PARAMETERS
from cell.measure.geometry.poses import difference, from_matrix
from cell.measure.vision.board.view import BoardView
from lab.bench.calibration.world import (
    HEIGHT,
    OWN,
    SHARED,
    WIDTH,
    Array,
    HeadWorld,
    Noise,
    draw_head,
    profile_of,
    seen_dots,
    seen_rows,
)
from lab.bench.over_cores import Done, over_cores
from sim_backends.optics.camera import project_points

STEPS = np.array(
    [1e-2, 1e-2, 1e-2, 1e-2, 1e-4, 1e-3, 1e-5, 1e-5] + [1e-4] * 3 + [1e-5] * 3 + [1e-6] * 12  # lens, plane, rail, poses
)
DRAWS = 200


@dataclass(frozen=True, eq=False)
class Bound:
    """Covariance (26, 26) that no unbiased calibration of this head under this noise can be below. `error` (26,) is
    what the best calibration, one that attains the bound, makes of the observations that were given."""

    covariance: Array
    error: Array = field(default_factory=lambda: np.zeros(SHARED))

    def draws(self, rng: np.random.Generator) -> Array:
        """Errors (200, 26) of the shared parameters as the best calibration would make them."""
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-30))
        values, vectors = np.linalg.eigh(self.covariance / scale[:, None] / scale)
        return np.asarray(rng.standard_normal((DRAWS, SHARED)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T * scale)


def cramer_rao(world: HeadWorld, noise: Noise, observations: Sequence[ScanObservation] | None = None) -> Bound:
    """The bound; poses of the flange and positions of the rail are unknowns that are read with their noise. With
    `observations`, one of each view, the bound is that of the dots that they hold, and has their best error."""
    total, score = np.zeros((SHARED, SHARED)), np.zeros(SHARED)
    prior = np.diag(1 / noise.own**2)
    nothing = np.zeros(OWN)
    views = range(len(world.rails))
    ids = [seen_dots(world.dots(view, nothing)) for view in views]
    rows = [np.flatnonzero(seen_rows(world, view, nothing)[1]) for view in views]
    if observations is not None:
        ids = [o.view.ids for o in observations if o.view is not None]
        rows = [
            row[np.isfinite(o.profile.centres[row])]
            for row, o in zip(rows, observations, strict=True)
            if o.profile is not None
        ]

    def predicted(there: HeadWorld, view: int, own: Array) -> Array:
        dots = there.dots(view, own)[ids[view]] / noise.dots
        return np.concatenate([dots.ravel(), there.stripe(view, own, rows[view].astype(float))[0] / noise.stripe])

    pairs = [(world.moved(step), world.moved(-step)) for step in np.diag(STEPS)]
    for view in views:
        shared = [
            (predicted(more, view, nothing) - predicted(less, view, nothing)) / (2 * size)
            for (more, less), size in zip(pairs, STEPS, strict=True)
        ]
        here = np.column_stack(shared)
        mine = differentiated(lambda own, view=view: predicted(world, view, own), np.full(OWN, 1e-6))  # type: ignore[misc]
        left = np.linalg.solve(mine.T @ mine + prior, mine.T)
        total += here.T @ here - here.T @ mine @ (left @ here)
        if observations is not None:
            off = _measured(observations[view], noise, rows[view]) - predicted(
                world, view, _as_read(world, view, observations[view])
            )
            score += here.T @ off - here.T @ mine @ (left @ off)
    scale = 1 / np.sqrt(np.diag(total))
    covariance = np.linalg.inv(total * scale[:, None] * scale) * scale[:, None] * scale
    covariance = 0.5 * (covariance + covariance.T)
    return Bound(covariance, covariance @ score)


def _measured(
    observation: ScanObservation, noise: Noise, rows: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
) -> Array:
    """Dots and stripe of an observation, whitened, in the order of the prediction."""
    assert observation.view is not None and observation.profile is not None
    stripe = observation.profile.centres[rows] / noise.stripe
    return np.concatenate([observation.view.pixels.ravel() / noise.dots, stripe])


def _as_read(world: HeadWorld, view: int, observation: ScanObservation) -> Array:
    """A view's own parameters (7,) when flange and rail are where they are said to be."""
    own = np.zeros(OWN)
    own[6] = observation.rail_position - world.rails[view]
    return own


def differentiated(function: Callable[[Array], Array], steps: Array) -> Array:
    """Jacobian (m, n) at zero of a function of n arguments, by central differences of the given steps (n,)."""
    columns = []
    for k, size in enumerate(steps):
        step = np.zeros(len(steps))
        step[k] = size
        columns.append((function(step) - function(-step)) / (2 * size))
    return np.column_stack(columns)


FRAMES = ("scan", "scan_aligned", "base")
SCAN_POINTS, BASE_POINTS = 1000, 45
STAND_OFF, RELIEF = 0.130, 0.015
LENS_TO_MOUNT = 20
"""So many of the generator's parameters describe the head itself; the rest is the board."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One seed: χ² per degree of freedom (with the noise found, and with the noise drawn), z-scores of the parameters,
    and for each frame the errors in mm (`measured_errors`).

    `z_whitened` is the RMS of the z-scores' independent parts, `best_z_whitened` the same of the best calibration on
    the same noise: 1 but for luck, which both share.
    """

    seed: int
    chi2_per_dof: float
    chi2_drawn_noise: float
    noise_found: dict[str, float]
    z: dict[str, float]
    z_whitened: float
    best_z_whitened: float
    errors: dict[str, dict[str, float]]


def campaign(seeds: Sequence[int], noise: Noise, done: Done) -> dict[str, Any]:
    """Run the seeds on all cores and sum them up; `done` is told of each."""
    tasks = [(one_trial, seed, noise) for seed in seeds]
    return summed_up(over_cores(tasks, ended=lambda trial: done(f"head {trial.seed}")), noise)


def one_trial(seed: int, noise: Noise) -> Trial:
    """Draw, calibrate, measure."""
    rng = np.random.default_rng(seed)
    world = draw_head(rng)
    observations = observe(world, noise, rng)
    nominal = nominal_camera(load_config(None).scan_camera)
    priors = noise.priors
    joint = solve_joint(observations, solve_staged(observations, nominal), priors, held_out=False)
    found = joint.adjusted
    exact = Adjustment(joint.views, shared_mask(plane=True, rail=True), replace(priors, dots_scale=1.0))
    fixed = exact.solve(start_state(joint.staged), variance_rounds=0)
    estimate = _as_world(world, found.state)
    error = _parameter_errors(found.state, world)
    covariance = found.covariance[: len(error), : len(error)]
    sigma = np.sqrt(np.diag(covariance))
    free = sigma > 0
    best = cramer_rao(world, noise, observations)
    errors = {frame: measured_errors(world, estimate, best, frame=frame, noise=noise, rng=rng) for frame in FRAMES}
    head = slice(0, LENS_TO_MOUNT)
    return Trial(
        seed, found.chi2_per_dof, fixed.chi2_per_dof,
        {"dots": found.priors.dots_scale, "stripe": found.priors.stripe_scale},
        {n: float(e / s) for n, e, s in zip(PARAMETERS, error, sigma, strict=True) if s > 0},
        _whitened(error[free], covariance[np.ix_(free, free)]),
        _whitened(best.error[head], best.covariance[head, head]), errors,
    )  # fmt: skip


def _whitened(error: Array, covariance: Array) -> float:
    """RMS of the independent standard scores of an error (n,) with covariance (n, n)."""
    scale = np.sqrt(np.diag(covariance))
    z = error / scale
    return float(np.sqrt(z @ np.linalg.solve(covariance / scale[:, None] / scale, z) / len(z)))


def observe(world: HeadWorld, noise: Noise, rng: np.random.Generator) -> list[Any]:
    """What the head sees and its devices report, as `ScanObservation`s with noise; the flange is said to be as sent."""
    made = []
    for view in range(len(world.rails)):
        own = noise.own * rng.normal(size=7)
        own[6] = 0.0
        pixels = world.dots(view, own)
        pixels += noise.dots * rng.normal(size=pixels.shape)
        ids = seen_dots(pixels)
        columns, _ = seen_rows(world, view, own)
        columns += noise.stripe * rng.normal(size=HEIGHT)
        board = BoardView(
            world.spec, (WIDTH, HEIGHT), ids, pixels[ids], np.full(len(ids), noise.dots), False, world.spec.dot_radius
        )
        reading, flange = float(world.rails[view] + noise.rail * rng.normal()), from_matrix(world.flanges[view])
        made.append(ScanObservation(board, profile_of(columns, noise.stripe), flange, reading, f"view {view + 1}"))
    return made


def _as_world(world: HeadWorld, state: Any) -> HeadWorld:
    """The estimate in the generator's terms, so that both measure with the same independent code."""
    parameters = np.concatenate(
        [state.camera.parameters[:8], state.plane.n / state.plane.distance, state.rail_direction]
    )
    return HeadWorld(
        parameters, state.flange_from_camera.homogeneous, state.base_from_board.homogeneous, world.flanges, world.rails,
        world.spec,
    )  # fmt: skip


def _parameter_errors(state: Any, world: HeadWorld) -> Array:
    """Errors (21,) of the estimate in the order and the terms of the calibration's covariance."""
    length = np.linalg.norm(world.plane)
    normal, distance = world.plane / length, 1 / length
    if state.plane.distance < 0:
        normal, distance = -normal, -distance
    across = tangents(state.plane.n)
    return np.concatenate(
        [
            state.camera.parameters - world.lens,
            [(state.plane.n - normal) @ a for a in across],
            [state.plane.distance - distance],
            state.rail_direction - world.rail,
            difference(state.flange_from_camera, from_matrix(world.hand)),
        ]
    )


def summed_up(trials: Sequence[Trial], noise: Noise) -> dict[str, Any]:
    """Means over the seeds; `z_rms` of all z-scores, by parameter, and of their independent parts; lengths in mm.
    `ratio` compares with the bound, `ratio_same_noise` with what the best calibration makes of the very noise drawn."""
    z = {name: np.array([t.z[name] for t in trials]) for name in trials[0].z}
    frames = {}
    for frame in FRAMES:
        mean = {key: float(np.mean([t.errors[frame][key] for t in trials])) for key in trials[0].errors[frame]}
        ratios = {"ratio": mean["mean"] / mean["bound_mean"], "ratio_same_noise": mean["mean"] / mean["best_mean"]}
        frames[frame] = {**mean, **ratios}
    chi2 = [t.chi2_per_dof for t in trials]
    drawn = [t.chi2_drawn_noise for t in trials]
    return {
        "seeds": len(trials),
        "assumed_noise": noise.as_dict(),
        "chi2_per_dof": {"mean": float(np.mean(chi2)), "least": min(chi2), "most": max(chi2)},
        "chi2_per_dof_drawn_noise": {"mean": float(np.mean(drawn)), "least": min(drawn), "most": max(drawn)},
        "noise_found": {key: float(np.mean([t.noise_found[key] for t in trials])) for key in ("dots", "stripe")},
        "z_rms": float(np.sqrt(np.mean([v**2 for v in z.values()]))),
        "z_rms_whitened": _rms([t.z_whitened for t in trials]),
        "best_z_rms_whitened": _rms([t.best_z_whitened for t in trials]),
        "z_rms_by_parameter": {name: float(np.sqrt(np.mean(v**2))) for name, v in z.items()},
        "frames_mm": frames,
        "trials": [asdict(t) for t in trials],
    }  # fmt: skip


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def measured_errors(
    world: HeadWorld, estimate: HeadWorld, best: Bound, frame: str, noise: Noise, rng: np.random.Generator
) -> dict[str, float]:
    """Errors in mm in one frame: `mean`, `max`, `p85` of the estimate; `best_mean` on the same noise; `bound_mean`.
    Stripe and rail (and the arm, in its base) have fresh noise, as when a surface is scanned."""
    count = BASE_POINTS if frame == "base" else SCAN_POINTS
    pixels, rails = sweep_points(world, count, rng)
    truth = _in_frame(world, pixels, rails, frame)
    noisy = pixels + np.column_stack([noise.stripe * rng.normal(size=count), np.zeros(count)])
    readings = rails + noise.rail * rng.normal(size=count)
    both = (estimate, world.moved(best.error))
    off = np.array([_in_frame(head, noisy, readings, frame) - truth for head in both])
    draws = best.draws(rng)
    jacobian = differentiated(lambda d: _in_frame(world.moved(d), pixels, rails, frame).ravel(), STEPS)
    aside = pixels + np.array([1e-3, 0.0])
    by_pixel = (_in_frame(world, aside, rails, frame) - truth) / 1e-3
    by_rail = (_in_frame(world, pixels, rails + 1e-6, frame) - truth) / 1e-6
    bound = (draws @ jacobian.T).reshape(len(draws), count, 3)
    bound += by_pixel * noise.stripe * rng.normal(size=(len(draws), count, 1))
    bound += by_rail * noise.rail * rng.normal(size=(len(draws), count, 1))
    if frame == "base":
        # The arm stands at one pose for the sweep, where it does not quite stand as it says.
        arm = noise.own[:6] * rng.normal(size=(len(draws) + 1, 6))
        swing = np.cross(arm[:, None, 3:], truth) + arm[:, None, :3]
        off, bound = off - swing[0], bound - swing[1:]
    if frame == "scan_aligned":
        off, bound = _aligned(off, truth), _aligned(bound, truth)
    size, best_size = 1e3 * np.linalg.norm(off, axis=2)
    return {
        "mean": float(size.mean()), "max": float(size.max()), "p85": float(np.percentile(size, 85)),
        "best_mean": float(best_size.mean()), "bound_mean": float(1e3 * np.linalg.norm(bound, axis=2).mean()),
    }  # fmt: skip


def sweep_points(world: HeadWorld, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Stripe pixels (n, 2) and rail positions (n,) in m of points spread over a 70 × 36 × 15 mm place under a sweep."""
    middle = 0.05
    points = np.column_stack(
        [rng.uniform(-0.035, 0.035, count), rng.uniform(-0.0165, 0.0165, count), STAND_OFF - RELIEF * rng.random(count)]
    )
    points += middle * world.rail + np.array([(1 - world.plane[2] * STAND_OFF) / world.plane[0], 0.0, 0.0])
    # The carriage stands where the light plane goes through the point.
    rails = (points @ world.plane - 1) / (world.rail @ world.plane)
    return project_points(points - rails[:, None] * world.rail, world.lens), rails


def _in_frame(world: HeadWorld, pixels: Array, rails: Array, frame: str) -> Array:
    points = world.measured(pixels, rails)
    if frame != "base":
        return points
    return np.asarray(points @ world.hand[:3, :3].T + world.hand[:3, 3])


def _aligned(errors: Array, points: Array) -> Array:
    """Errors (…, n, 3) without the small rigid motion that explains most of them."""
    centred = points - points.mean(axis=0)
    motion = np.zeros((len(points), 3, 6))
    motion[:, :, :3] = np.eye(3)
    for axis in range(3):
        motion[:, :, 3 + axis] = np.cross(np.eye(3)[axis], centred)
    basis = np.linalg.qr(motion.reshape(-1, 6))[0]
    flat = errors.reshape(*errors.shape[:-2], -1)
    return np.asarray((flat - flat @ basis @ basis.T).reshape(errors.shape))
