"""Verify: the placed part and what shows of the surface around it are swept; it lies in its place, or the run fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from cell.config.job import Job, PlaceSection
from cell.measure.geometry.poses import difference, from_parts, perturbed, transform
from cell.measure.inversion import NominalSurface, PlacePose, Prior, Tolerance
from cell.measure.inversion.mating import MatingGap, scanned_gap
from cell.measure.inversion.part_pose import PartPose, find_part, of_part, seen_from_above
from cell.measure.reconstruction import Cloud, write_cloud
from cell.measure.reconstruction.cloud import Indices
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import PartState
from cell.procedures.part_error import draws_of, part_covariance, part_points
from cell.procedures.steps.correction import along_surface, correct, hoped
from cell.procedures.steps.laser_sweep import head_at, laser_sweep
from cell.procedures.steps.place import PlaceResult
from cell.procedures.steps.reconstruct import Reconstruction, build_cloud, displacements
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.errors import Measured, MisplacedError, RefusedError
from drivers.interfaces import Vector
from statemachine.runner import StepContext
from statemachine.step import OnFailure, Step

CLOUD = "placed.ply"
UNCLEAR = "nothing moved it: it is farther off than a place is known to, or not seen well enough"
CLEARLY = 3.0
"""Standard deviations of the stated place beyond which a part has not come to lie so by chance."""
FARTHEST_M = 2e-3
"""A part that lies farther aside is not gripped: the fingers may not find it as it lies."""
WORTH = 0.75
"""A part is corrected where it lies so many times as far off as it would after it, on average: every second part then
comes to lie nearer, as what is configured of the arm is what it keeps to and a little more."""
NEXT_STEP = "See to it, take the part away, then run the job with the next part"
LIKELY = {
    "raised": "it lies on something, or is another part: look under it",
    "deep": "the part or the surface is worn, or another one",
    "shifted": "it slipped in the claw, or as the claw opened: look at the fingers",
    "tilted": "it stands on something at one edge, or was held tilted: look under it",
}


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """Where the placed part was `seen`, beside where it `belongs` (surface_from_part).

    `points` (45, 3) m, part frame, are those by which a placed part is judged. `covariance` (6, 6) is that of the seen
    pose, surface axes, about the part's origin; `stated` (6, 6) is that of the place before it was put down, which
    stands for the motions that its faces do not show, `unseen`. `gap` is the gap below it, as it lies; None where
    nothing scanned lies below. `before` is how far off, m, it lay before each correction.
    """

    seen: PartPose
    belongs: pin.SE3
    points: Vector
    covariance: Vector
    stated: Vector
    unseen: tuple[str, ...] = ()
    gap: MatingGap | None = None
    before: tuple[float, ...] = ()

    @cached_property
    def offsets(self) -> Vector:
        """How far each point lies from where it belongs, (45, 3) m, surface axes."""
        return transform(self.seen.surface_from_part, self.points) - transform(self.belongs, self.points)

    @property
    def turn(self) -> Vector:
        """By how much the part is turned from where it belongs, (3,) rad, surface axes."""
        return np.asarray(pin.log3(self.seen.surface_from_part.rotation @ self.belongs.rotation.T))

    @cached_property
    def _errors(self) -> Vector:
        """What the points' places may be off by, (2000, 45, 3) m."""
        arms = transform(self.seen.surface_from_part, self.points) - self.seen.surface_from_part.translation
        drawn = draws_of(self.covariance)
        return np.asarray(drawn[:, None, :3] + np.cross(drawn[:, None, 3:], arms))

    @property
    def off(self) -> float:
        """How far its points lie from where they belong, on average, m."""
        return float(np.linalg.norm(self.offsets, axis=1).mean())

    @property
    def aside(self) -> float:
        """The same along the surface alone: how high and how tilted a part lies, what it lies on tells."""
        motion = along_surface(self.belongs.inverse() * self.seen.surface_from_part)
        return float(np.linalg.norm(transform(motion, self.points) - self.points, axis=1).mean())

    @property
    def unsure(self) -> float:
        """What 95 % of the points are known to, m."""
        return float(np.percentile(np.linalg.norm(self._errors, axis=-1), 95))

    @cached_property
    def bound(self) -> dict[str, float]:
        """Below what, mm, 95 % of the points lie from where they belong, by axis of the surface's frame and for D.

        Where they were seen counts, and at 95 % what that may be off by.
        """
        errors = 1e3 * np.abs(self.offsets + self._errors)
        found = {name: errors[..., k] for k, name in enumerate("xyz")} | {"d": np.linalg.norm(errors, axis=-1)}
        return {name: float(np.percentile(np.percentile(each, 95, axis=1), 95)) for name, each in found.items()}

    @property
    def turn_bound(self) -> float:
        """By how much the part is turned at most, rad, at 95 %."""
        turned = self.turn + draws_of(self.covariance)[:, 3:]
        return float(np.percentile(np.linalg.norm(turned, axis=-1), 95))

    @property
    def doubtful(self) -> str:
        """What to do where the surface was not seen beside the part."""
        return "" if self.seen.beside else ". Have more of the surface show beside the part: less would be left open"

    @property
    def words(self) -> str:
        """For people."""
        gap = "" if self.gap is None else f", gap {self.gap.span}"
        where = "" if self.seen.beside else ", against the surface as swept before"
        return f"{1e3 * self.off:.2f} ± {1e3 * self.unsure:.2f} mm off{where}{gap}"

    @cached_property
    def _times(self) -> Vector:
        """How far it is off its place, (6,), in standard deviations of the stated place: along x, y, z, and about them,
        about its origin."""
        off = np.concatenate([self.seen.surface_from_part.translation - self.belongs.translation, self.turn])
        return np.asarray(off / np.sqrt(np.diag(self.stated)))

    @property
    def likely(self) -> str:
        """What has most likely happened to a part that does not lie in its place.

        A part that slipped comes to lie on slopes and edges, so it is tilted and raised as well; one that stands on
        something at an edge is raised as well. So the first of them that is clear counts.
        """
        x, y, z, about_x, about_y, about_z = np.abs(self._times)
        times = {"shifted": max(x, y, about_z), "tilted": max(about_x, about_y)}
        times["raised" if self._times[2] > 0.0 else "deep"] = z
        clear = (name for name, size in times.items() if size > CLEARLY)
        return next((LIKELY[name] for name in clear), UNCLEAR)

    def measured(self, place: PlaceSection) -> tuple[Measured, Measured]:
        """What it is judged by, beside the place's tolerances."""
        return (
            Measured("placed part off its place, 95 % bound", self.bound["d"], "mm", most=1e3 * place.tolerance),
            Measured("placed part turned, 95 % bound", 1e3 * self.turn_bound, "mrad", most=1e3 * place.tolerance_angle),
        )

    def kept(self, place: PlaceSection) -> bool:
        """Whether it is known to lie within the place's tolerances."""
        return all(number.kept for number in self.measured(place))

    def misplaced(self, place: PlaceSection, more: str = "") -> MisplacedError:
        """The error of a part that is not known to lie within the place's tolerances."""
        off, turned = self.measured(place)
        shift = ", ".join(f"{1e3 * v:+.2f}" for v in self.offsets.mean(axis=0))
        turn = ", ".join(f"{1e3 * v:+.1f}" for v in self.turn)
        return MisplacedError(
            f"the placed part lies {self.words}, by ({shift}) mm and ({turn}) mrad in the surface's axes. Allowed are "
            f"{1e3 * place.tolerance:g} mm and {1e3 * place.tolerance_angle:g} mrad; at 95 % it may be "
            f"{off.value:.2f} mm and {turned.value:.1f} mrad. Most likely {self.likely}{self.doubtful}. "
            f"{more}{more and '. '}{NEXT_STEP}",
            off, turned,
        ).showing(seen={"placed": self})  # fmt: skip

    @property
    def notes(self) -> tuple[str, ...]:
        """For people: how it lies, whether that is as usual, and what was not seen."""
        more = f"that is farther off than was stated before it was put down: most likely {self.likely}"
        return (
            f"the placed part lies {self.words}",
            *((more,) if np.abs(self._times).max() > CLEARLY else ()),
            *(f"not seen of the placed part: {motion}" for motion in self.unseen),
        )

    def summary(self) -> dict[str, object]:
        """Figures for journal and report."""
        shift, turn = self.offsets.mean(axis=0), self.turn
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            "off_mm": round(1e3 * self.off, 4), "unsure_mm": round(1e3 * self.unsure, 4),
            "shift_mm": [round(1e3 * float(v), 4) for v in shift],
            "turn_mrad": [round(1e3 * float(v), 4) for v in turn],
            "sigma_mm": [round(1e3 * float(v), 4) for v in sigma[:3]],
            "sigma_mrad": [round(1e3 * float(v), 4) for v in sigma[3:]],
            "points": self.seen.fit.n_points, "beside": self.seen.beside, "unseen": list(self.unseen),
            "gap": None if self.gap is None else self.gap.as_dict(),
            "before_mm": [round(1e3 * off, 4) for off in self.before],
        }  # fmt: skip


def _at(here: Workplace, context: StepContext) -> PlacedPart:
    placed = context.made(PlaceResult)
    pose, plan = placed.pose or context.made(PlacePose), here.job.place
    found, slip = _looked(here, pose, context), pin.SE3.Identity()
    for _ in range(plan.corrections):
        if not _worth_correcting(here, pose, found, context):
            break
        context.note(text=f"the placed part lies {found.words}: it is gripped and placed again")
        held = placed.base_from_flange.inverse() * pose.base_from_surface * found.seen.surface_from_part
        try:
            placed = correct(here, placed, pose, held=held, slip=slip, seen=found.covariance, context=context)
        except RefusedError as error:
            if here.part.state is not PartState.RELEASED:
                raise
            here.mover.to_joints(HOME)
            raise found.misplaced(plan, f"It was not corrected: {error}") from error
        for note in placed.notes:
            context.note(text=note)
        found = replace(_looked(here, pose, context), before=(*found.before, found.off))
        # How it was held was seen: what it is off by to the side now came as the claw opened, and comes again.
        let_go = placed.base_from_flange * held
        slip = along_surface(let_go.inverse() * pose.base_from_surface * found.seen.surface_from_part)
    for note in found.notes:
        context.note(text=note)
    if not found.kept(plan):
        raise found.misplaced(plan)
    return found


def _worth_correcting(here: Workplace, pose: PlacePose, found: PlacedPart, context: StepContext) -> bool:
    """Whether the part lies farther off than is accepted, and a correction would bring it nearer."""
    plan = here.job.place
    if found.off <= (plan.tolerance if plan.accept is None else plan.accept) and found.kept(plan):
        return False
    hope = hoped(here, pose, found.points, found.covariance)
    if WORTH * hope < found.aside < FARTHEST_M:
        return True
    context.note(
        text=f"no correction of the placed part, {found.words}: to the side it is {1e3 * found.aside:.2f} mm off, and "
        f"would be {1e3 * hope:.2f} mm (farthest: {1e3 * FARTHEST_M:g} mm)"
    )
    return False


def _looked(here: Workplace, pose: PlacePose, context: StepContext) -> PlacedPart:
    """Sweep the placed part, fold the arm, and find the part in the sweep."""
    sweep, scan, part = context.made(SweepRecord), context.made(Reconstruction), here.part_mesh
    if part is None:
        raise RefusedError("the job has no mesh of its part ([part]): nothing tells what the placed part looks like")
    place, belongs = here.job.place, here.job.place.surface_from_part.se3()
    faces, tolerance = seen_from_above(part, belongs), Tolerance(place.tolerance, place.tolerance_angle)
    while True:
        held = context.held_s
        cloud, record = _swept(here, sweep, pose, faces, context)
        context.progress(0.9, "folding the arm, and looking whether the rail has lost steps")
        looking = here.devices.rail.check_zero() if here.job.scan.mode == "rail" else None
        here.mover.to_joints(HOME)
        if looking is not None:
            looking.wait(30.0)
        context.safe_point()
        # Whoever has the run held may reach in, and move the part.
        if context.held_s == held:
            break
    by_calibration, by_poses = displacements(here, record, cloud)

    def moved(lines: Indices, rows: Indices) -> Vector:
        return np.concatenate([by_calibration(lines, rows), by_poses(lines, rows)], axis=2)

    try:
        seen = find_part(
            cloud, faces, here.nominal, surface=Prior(pose.base_from_surface, pose.covariance), belongs=belongs,
            tolerance=tolerance, moved=moved, times=record.times,
            base_from_vehicle=here.config.arm.vehicle_from_base.se3().inverse(),
        )  # fmt: skip
    except RefusedError as error:
        why = str(error).partition(". ")[0].replace("nominal surface", "drawing of the part")
        raise MisplacedError(
            f"the placed part is not where it was put down, or is not the part as drawn: {why}. {NEXT_STEP}",
            *error.numbers,
        ) from error
    stated = part_covariance(here.job, pose, here.repeatability)
    gap = scanned_gap(scan.cloud, pose.base_from_surface, here.nominal, seen.surface_from_part, part)
    return replace(judged(here.job, seen, part_points(here.nominal), stated), gap=gap)


def _swept(
    here: Workplace, sweep: SweepRecord, pose: PlacePose, faces: NominalSurface, context: StepContext
) -> tuple[Cloud, SweepRecord]:
    """Sweep the part, with the head as far above its faces as it was above the surface."""
    again = laser_sweep(
        here, pose.base_from_surface * surface_from_faces(here.job, faces), head_at(here, sweep), here.job.scan,
        check=context.check, keep_frame=lambda frame: here.frames.keep("verify", frame), counted=False,
        progress=lambda share, text: context.progress(0.85 * share, f"the placed part: {text}"),
    )  # fmt: skip
    cloud = build_cloud(again)
    write_cloud(here.folder / CLOUD, cloud, here.config.cell.sim)
    return cloud, again


def surface_from_faces(job: Job, faces: NominalSurface) -> pin.SE3:
    """The surface's frame, moved up to half the height of the placed part's faces: what the sweep of these is over."""
    middle = job.place.surface_from_part.se3() * (0.5 * sum(faces.extent))
    return from_parts((0.0, 0.0, middle[2]))


def judged(job: Job, seen: PartPose, points: Vector, stated: Vector) -> PlacedPart:
    """The part as `seen`, with what is not seen of it as it was `stated`, (6, 6), surface axes.

    Raises `MisplacedError` where something is not seen, and the job does not content itself with the rest.
    """
    unit = np.array([job.place.tolerance] * 3 + [job.place.tolerance_angle] * 3)
    values, ways = np.linalg.eigh(seen.covariance / np.outer(unit, unit))
    weak = ~(3.0 * np.sqrt(np.maximum(values, 0.0)) <= 1.0)
    motions = seen.fit.verdict.weak
    unseen = tuple(of_part(motion.words.partition(" is ")[0]) for motion in motions)
    if unseen and job.place.verify == "all":
        raise MisplacedError(
            f"not all is seen of how the placed part lies: {'; '.join(of_part(m.words) for m in motions)}. Sweep more "
            'of it, or write place.verify = "seen"',
            *(motion.measured() for motion in motions),
        )
    instead = np.einsum("in,ij,jn->n", ways, stated / np.outer(unit, unit), ways)
    kept = (ways * np.where(weak, instead, values)) @ ways.T * np.outer(unit, unit)
    belongs = job.place.surface_from_part.se3()
    # Along what is not seen the part is taken to lie where it belongs: what the fit has there is noise.
    off = ways.T @ (difference(seen.surface_from_part, belongs) / unit)
    there = perturbed(belongs, unit * (ways @ np.where(weak, 0.0, off)))
    return PlacedPart(
        replace(seen, surface_from_part=there), belongs, points, covariance=kept, stated=stated, unseen=unseen
    )


# What was interrupted with the part between the fingers is left to a person. A correction takes up to 300 s.
STEP = JobStep(
    Step("verify", 1800.0, on_failure=OnFailure.STOP), _at, PlacedPart,
    needs=(SweepRecord, Reconstruction, PlacePose, PlaceResult),
)  # fmt: skip
