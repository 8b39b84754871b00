"""Points of a scan, measured with a calibrated head and with the best that the noise allows, frame by frame.

The camera's frame alone is partly gauge; the arm's base is what placing feels. Errors and bound have the same fresh
noise of stripe, rail and arm, and the best calibration the same observations, so that both share their luck.
"""

from __future__ import annotations

import numpy as np

from lab.bench.calibration.bound import STEPS, Bound, differentiated
from lab.bench.calibration.world import Array, HeadWorld, Noise

FRAMES = ("camera", "scan", "scan_radial_lens", "scan_aligned", "base")
SCAN_POINTS, BASE_POINTS = 1000, 45
STAND_OFF, RELIEF = 0.130, 0.015


def measured_errors(
    world: HeadWorld, estimate: HeadWorld, best: Bound, frame: str, noise: Noise, rng: np.random.Generator
) -> dict[str, float]:
    """Errors in mm in one frame: `mean`, `max`, `p85` of the estimate; `best_mean` on the same noise; `bound_mean`.

    Stripe and rail (and the arm, in its base) have fresh noise, as when a surface is scanned.
    """
    count = BASE_POINTS if frame == "base" else SCAN_POINTS
    rail_noise = 0.0 if frame == "camera" else noise.rail
    pixels, rails = sweep_points(world, count, rng)
    if frame == "camera":
        rails = np.zeros(count)
    truth = _in_frame(world, pixels, rails, frame)
    noisy = pixels + np.column_stack([noise.stripe * rng.normal(size=count), np.zeros(count)])
    readings = rails + rail_noise * rng.normal(size=count)
    both = (estimate, world.moved(best.error))
    off = np.array([_in_frame(head, noisy, readings, frame) - truth for head in both])
    draws = best.draws(rng)
    jacobian = differentiated(lambda d: _in_frame(world.moved(d), pixels, rails, frame).ravel(), STEPS)
    aside = pixels + np.array([1e-3, 0.0])
    by_pixel = (_in_frame(world, aside, rails, frame) - truth) / 1e-3
    by_rail = (_in_frame(world, pixels, rails + 1e-6, frame) - truth) / 1e-6
    bound = (draws @ jacobian.T).reshape(len(draws), count, 3)
    bound += by_pixel * noise.stripe * rng.normal(size=(len(draws), count, 1))
    bound += by_rail * rail_noise * rng.normal(size=(len(draws), count, 1))
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
    from sim_backends.optics.camera import project_points

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
