"""Whether the planned sweeps tell where the surface is, before anything is swept; and which motion they leave open.

The same inversion that a job does, on the points that the sweeps will see of the drawn surface.

Whether what the claw holds is in the way of light and sight: of the scan, and of the board's photograph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.apps.new_job.sweeps import Array, SeenSurface, as_cloud
from cell.config.cell_config import CellConfig, mounted
from cell.config.job import Job
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface, PlacePose, Prior, Tolerance, invert_pose
from cell.measure.inversion.observability import FREE, PoseVerdict, judge
from cell.measure.reconstruction.build import flange_motions
from cell.measure.vision.board.view import parse_board
from cell.motion.collision import Body, tool_bodies
from cell.procedures.arm.photograph import base_from_place_at_target, look_pose, photo_pose

MOST_HIDDEN = 0.02
"""Share of the scanned points that may be hidden behind what the claw holds."""
MARGIN = 0.002
"""How much larger the part is taken to be on each side, m."""


def sight_problems(job: Job, config: CellConfig, seen: Sequence[SeenSurface]) -> Iterator[str]:
    """A line for each view that the part in the claw, as drawn, hides."""
    part = tool_bodies(job.grasp.size, job.grasp.flange_from_part.se3(), mounted(config))[-1]
    sides = " x ".join(f"{1e3 * side:g}" for side in job.grasp.size)
    held = f"the part in the claw ({sides} mm, grasp.size)"
    hidden = [_hidden_share(each, part) for each in seen]
    if hidden and max(hidden) > MOST_HIDDEN:
        yield (
            f"sweep {int(np.argmax(hidden)) + 1}: {held} hides {100 * max(hidden):.0f} % of it from the scan camera or "
            f"the laser (allowed: {100 * MOST_HIDDEN:g} %); give the part's own size with --part-size, or hold it "
            "otherwise with --grasp"
        )
    board = parse_board(job.board.spec)
    base_from_place = base_from_place_at_target(config, job)
    hand = config.target_camera.flange_from_camera.se3()
    base_from_board = base_from_place * job.place_from_board
    for what, flange in (
        ("while the vehicle drives", look_pose(config, job, board, hand)),
        ("in the photograph", photo_pose(job, board, base_from_board, hand)),
    ):
        points = transform(flange.inverse() * base_from_board, board.points())
        eyes = np.tile(hand.translation, (len(points), 1))
        if (count := int(_crosses(eyes, points, part).sum())) > 0:
            yield (
                f"{held} hides {count} of {len(points)} points of the board from the target camera {what}; give the "
                "part's own size with --part-size, or hold it otherwise with --grasp"
            )
            return


def _hidden_share(seen: SeenSurface, part: Body) -> float:
    lines, rows = seen.valid.nonzero()
    if not len(lines):
        return 0.0
    every = max(1, len(lines) // 4000)
    lines, rows = lines[::every], rows[::every]
    flanges = seen.flanges[lines]

    def on_flange(points: Array) -> Array:
        return np.asarray(np.einsum("nji,nj->ni", flanges[:, :3, :3], points - flanges[:, :3, 3]))

    points = on_flange(seen.points[lines, rows])
    hidden = _crosses(on_flange(seen.eyes[lines]), points, part) | _crosses(on_flange(seen.lamps[lines]), points, part)
    return float(hidden.mean())


def _crosses(starts: Array, ends: Array, body: Body) -> NDArray[np.bool_]:
    """(n,) whether the way from start to end, flange frame, leads through the box."""
    into: pin.SE3 = body.placement.inverse()
    a, b = transform(into, starts), transform(into, ends)
    half = 0.5 * np.array(body.size) + MARGIN
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - a) / (b - a), (half - a) / (b - a)
    enter = np.nanmax(np.minimum(first, second), axis=1)
    leave = np.nanmin(np.maximum(first, second), axis=1)
    return np.asarray((enter < leave) & (leave > 0.0) & (enter < 1.0))


OVER = 1e-4
"""How far points of the drawing may lie from the surface that was cut out of it, m."""
FEW = 0.03
"""Share of the points that has to tell a shift: with less, on upright faces, true errors of six sigma were seen."""
BARELY = 1.5
"""So many times what the inversion takes for no information counts as none here: a scan may bring less than drawn."""


def prior_of(job: Job) -> Array:
    """Covariance (6, 6) of where the board puts the surface, S, m² and rad²."""
    surface = job.surface
    return np.diag([surface.prior_sigma**2] * 3 + [surface.prior_sigma_angle**2] * 3)


def shared_by_all(config: CellConfig) -> Array:
    """Covariance (6, 6) of what all points have in common: the arm's geometry as configured, m² and rad²."""
    arm = config.arm
    return np.diag([arm.kinematic_sigma**2] * 3 + [arm.kinematic_sigma_angle**2] * 3)


def verdict(information: Array, points: int, radius: float, job: Job, config: CellConfig) -> PoseVerdict:
    """What a scan of this information (6, 6) in `points` points leaves open. A motion that the scan hardly determines
    is left to the board altogether: what there is of it may be noise, or the drawing's facets."""
    length = np.array([1.0] * 3 + [radius] * 3)
    variance = points / max(float(np.trace(information[:3, :3])), 1e-9)
    spectrum, ways = np.linalg.eigh(information / np.outer(length, length))
    spectrum = np.where(spectrum * variance / points < BARELY * FREE, 0.0, spectrum)
    information = (ways * spectrum) @ ways.T * np.outer(length, length)
    known = np.linalg.inv(information + np.linalg.inv(prior_of(job)))
    gain = known @ information
    covariance = known + gain @ shared_by_all(config) @ gain.T
    return judge(covariance, information, variance, points=points, radius=radius, tolerance=_tolerance(job))


def known(seen: Sequence[SeenSurface], surface: NominalSurface, job: Job, config: CellConfig) -> PoseVerdict:
    """What these sweeps leave open, by the points that the inversion uses: those over `surface`, not at its borders."""
    used = [each.valid for each in seen]
    for mask, each in zip(used, seen, strict=True):
        index, feet = surface.feet(each.points[mask], OVER)
        over = np.zeros(int(mask.sum()), dtype=np.bool_)
        over[index] = feet.inner
        mask[mask] = over
    information = sum((each.information(mask) for each, mask in zip(seen, used, strict=True)), np.zeros((6, 6)))
    return verdict(information, sum(int(mask.sum()) for mask in used), surface.radius, job, config)


def told_by_few(seen: Sequence[SeenSurface], surface: NominalSurface) -> list[str]:
    """A line for x and for y where few points alone tell how the surface lies along it: those on upright faces."""
    points = np.concatenate([each.points[each.valid] for each in seen])
    normals = np.concatenate([each.normals[each.valid] for each in seen])
    index, feet = surface.feet(points, OVER)
    notes = []
    for k, axis in enumerate("xy"):
        weights = normals[index[feet.inner], k] ** 2
        share = float(weights.sum() ** 2 / max(1e-12, len(weights) * float((weights**2).sum())))
        if share < FEW:
            notes.append(
                f"how the surface lies along {axis} is told by {100 * share:.1f} % of the points alone, upright ones "
                f"(relief: {100 * FEW:g} % or more): the stated error may be too small there; prefer a side with relief"
            )
    return notes


def place_from(seen: Sequence[SeenSurface], nominal: NominalSurface, job: Job, config: CellConfig) -> PlacePose:
    """The place as the job's own inversion would tell it from these sweeps, without noise.

    Raises `NotObservable` that names the motion which surface and sweeps leave open, `RefusedError` when they cover
    too little of the surface.
    """
    cloud = as_cloud(list(seen), config.calibration.rail_sigma).require()
    arm = config.arm
    rest = np.diag([arm.repeatability**2] * 3 + [arm.repeatability_angle**2] * 3)
    return invert_pose(
        cloud, nominal, Prior(pin.SE3.Identity(), prior_of(job)), _tolerance(job), systematic=shared_by_all(config),
        sweeps=lambda lines, rows: flange_motions(cloud, lines, rows, [rest] * len(seen)),
    )  # fmt: skip


def _tolerance(job: Job) -> Tolerance:
    return Tolerance(job.place.tolerance, job.place.tolerance_angle)
