"""Correction: a part that was placed and seen is gripped again where it lies, and placed anew by what was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import composition_jacobians, transform
from cell.measure.inversion import PlacePose
from cell.measure.inversion.mating import scanned_gap
from cell.procedures.arm.touch import expected_touch
from cell.procedures.part_error import draws_of, part_points
from cell.procedures.steps.gripping import GRIPPED, held_so, note_part, take
from cell.procedures.steps.place import PlaceResult, Placing
from cell.procedures.steps.reconstruct import Reconstruction
from cell.procedures.steps.workplace import Workplace
from drivers.interfaces import Vector
from statemachine.runner import StepContext

SLIPS = 2.0
"""A part slips as the claw opens where it moves so many times as far as a correction leaves it off, on average."""


def brought(here: Workplace, pose: PlacePose, points: Vector, seen: Vector) -> Vector:
    """How far along the surface the part's `points` (n, 3), part frame, lie from where they belong after a correction,
    on average: drawn (2000,), m, from what the arm repeats to, and from what is not known of the part where it was
    `seen`, (6, 6), surface axes."""
    belongs = here.job.place.surface_from_part.se3()
    base_from_part = pose.base_from_surface * belongs
    flange = base_from_part * here.job.grasp.flange_from_part.se3().inverse()
    carried = composition_jacobians(flange, flange.inverse() * base_from_part)[0]
    turn = np.kron(np.eye(2), pose.base_from_surface.rotation.T)
    # It comes to rest twice: where it grips, and where it lets go.
    rests = turn @ carried @ (2.0 * here.repeatability) @ carried.T @ turn.T
    drawn = draws_of(rests + seen + GRIPPED)
    apart = drawn[:, None, :3] + np.cross(drawn[:, None, 3:], points @ belongs.rotation.T)
    return np.asarray(np.linalg.norm(apart[..., :2], axis=-1).mean(axis=1))


def hoped(drawn: Vector, corrections: int) -> float:
    """How far off a part is on average after up to `corrections`, of which each leaves it as far off as one of `drawn`
    (n,), and which end as soon as those left promise no more: the optimal stopping of a search without recall."""
    hope = float(drawn.mean())
    for _ in range(corrections - 1):
        hope = float(np.minimum(drawn, hope).mean())
    return hope


def correct(
    here: Workplace, placed: PlaceResult, pose: PlacePose, *, held: pin.SE3, slip: pin.SE3, seen: Vector,
    context: StepContext,
) -> PlaceResult:  # fmt: skip
    """Grip the part, with the flange where it was let go, and place it anew; the arm stays above.

    The claw then has it at `held`, flange_from_part, known to `seen` (6, 6). `slip` is how it moves as the claw opens,
    part frame before from part frame after.

    Raises what `Placing.put_down` raises, and `RefusedError` where something is met on the way to the part.
    """
    belongs, points = here.job.place.surface_from_part.se3(), part_points(here.nominal)
    far = float(np.linalg.norm(transform(slip, points) - points, axis=1).mean())
    if far < SLIPS * hoped(brought(here, pose, points, seen), 1):
        # As little comes of the arm.
        slip = pin.SE3.Identity()
    job = held_so(here.job, held * slip, seen)
    expected = expected_touch(job, here.nominal, pose, here.repeatability)
    part = here.part_mesh
    assert part is not None
    cloud = context.made(Reconstruction).cloud
    # Aimed beside its place, it touches slopes of the surface higher up.
    gap = scanned_gap(cloud, pose.base_from_surface, here.nominal, belongs * slip.inverse(), part)
    if gap is not None:
        gap.require(here.job.place.tolerance)
        expected = replace(expected, height=expected.height + gap.lift)
    take(here, job, placed.base_from_flange, context, what="the placed part")
    placing = Placing(
        job, pose.base_from_surface, expected, mover=here.mover, arm=here.devices.arm, claw=here.devices.claw,
        part=here.part, check=context.check, progress=lambda share, text: context.progress(0.5, f"again: {text}"),
        note=lambda part: note_part(context, part),
    )  # fmt: skip
    return replace(placing.put_down(fold=False), look=placed.look, pose=pose, mating=gap)
