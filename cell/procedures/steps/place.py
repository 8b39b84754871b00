"""Place: approach, guarded descent until contact, release, retreat."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from cell.config.job import Job
from cell.measure.geometry.poses import from_parts, from_ur, to_ur
from cell.measure.inversion import PlacePose
from cell.measure.inversion.disagreement import highest_standing, require_bare
from cell.measure.inversion.effects.between_sweeps import Creep
from cell.measure.inversion.mating import APART, LEAST_SEEN, NEXT_STEP, MatingGap, scanned_gap
from cell.motion.collision import TOUCHES
from cell.procedures.arm.moves import Mover, PartProgress, PartState
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.arm.touch import FELT_M, REFUSED, TouchCheck, TouchHeight, expected_touch, felt_touch
from cell.procedures.grasp import expected_residual, job_with_grasp
from cell.procedures.part_error import part_points
from cell.procedures.steps.board_photo import require_board_unmoved
from cell.procedures.steps.invert_pose import inverted
from cell.procedures.steps.reconstruct import Reconstruction, together
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.second_look import SecondLook, require_in_place
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.errors import CellError, Measured, NotObservable, RefusedError
from drivers.interfaces import Arm, ArmState, Claw
from statemachine.runner import StepContext
from statemachine.step import OnFailure, Step

APPROACH_S = 1.8
"""About what the arm takes from the scan pose to where it feels for contact."""
FREE_M = 0.15e-3
"""Where the part before touched within `ALIKE_M` of where it should, contact is felt for from so far above the highest
touch that is allowed: one that comes earlier is then seen to, and what the force reads of nothing."""
ALIKE_M = 0.1e-3
FAST_FORCE = 3.0
"""Times the contact force at which the faster part of the descent ends: accelerating the part is felt as well."""
NEAR_M = 5e-3
"""So far above its end the fast part of the descent, and the way up, go at `place.speed`; beyond, faster."""


@dataclass(frozen=True, eq=False)
class PlaceResult:
    """Where the flange was when the part was let go, how far off in depth, m, and where the part touched first.

    `look` is what was seen of the surface between its sweep and the descent; None where it was measured without a
    sweep. `pose` is where it was placed to: the inverted one, carried on where something creeps. `mating` is the gap
    below the part as drawn, where the job has a mesh of it. `allowed` is how the part was taken to come to lie aside,
    part frame: as the parts before it did, of which there were `parts`.
    """

    base_from_flange: pin.SE3
    contact: bool
    depth_error: float
    touch: TouchCheck | None = None
    look: SecondLook | None = None
    pose: PlacePose | None = None
    mating: MatingGap | None = None
    allowed: pin.SE3 = field(default_factory=pin.SE3.Identity)
    parts: int = 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not as usual, for people."""
        seen = () if self.look is None else self.look.notes
        seen += () if self.mating is None else self.mating.notes
        if self.touch is None:
            return (*seen, "the first touch was not held against the scan: the arm told too little of the way down")
        return (*seen, *self.touch.notes)

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        more: dict[str, object] = {} if self.mating is None else {"mating": self.mating.as_dict()}
        if self.parts:
            more["allowed_for"] = {
                "shift_mm": [round(1e3 * float(v), 4) for v in self.allowed.translation[:2]],
                "turn_mrad": round(1e3 * float(pin.log3(self.allowed.rotation)[2]), 4),
                "parts": self.parts,
            }
        return more | {
            "contact": self.contact,
            "depth_error_mm": round(1e3 * self.depth_error, 4),
            "touch": None if self.touch is None else self.touch.as_dict(),
            "surface_moved": None if self.look is None else self.look.moved.as_dict(),
            "creep": None if self.look is None or self.look.creep is None else self.look.creep.as_dict(),
            "base_from_flange": [round(float(v), 6) for v in to_ur(self.base_from_flange)],
            "base_from_flange_units": {"translation": "m", "rotation_vector": "rad"},
        }


@dataclass(frozen=True, eq=False)
class Placing:
    """One part to be put onto the surface whose pose was measured: with what, and who is told and asked meanwhile.

    `expected` is where the part is to touch first. `part` follows what becomes of the part. `note` is called before the
    claw is told to release it, and again as soon as it has, before anything else is done. `check` raises when the run
    is to end, `ready` where the part is not to touch the surface: it is asked once the part is just above. `feel` is
    how far, m, above its place that is, `place.contact_travel` if not told.
    """

    job: Job
    base_from_surface: pin.SE3
    expected: TouchHeight
    mover: Mover
    arm: Arm
    claw: Claw
    part: PartProgress
    check: Callable[[], None]
    progress: Callable[[float, str], None]
    note: Callable[[PartProgress], None]
    ready: Callable[[], None] = lambda: None
    feel: float | None = None

    def put_down(self, fold: bool = True) -> PlaceResult:
        """Put the part onto the surface, and fold the arm unless somebody looks at the part from where it stands then.

        Straight down the surface's normal: fast at first, at `place.speed` to just above, at `contact_speed` until the
        force changes by `contact_force`. Raises `RefusedError` before anything moves when the part is not held any
        more. It does so with the part still held and lifted when contact comes too early, not at all, or where the
        stated uncertainty of the place does not allow it.
        """
        require_held(self.part)
        self._approach()
        self._descend()
        self._require_ready()
        contact, states = self._feel()
        reached = from_ur(self.arm.state().flange)
        off = self._depth()
        self._require_contact(contact, off)
        touch = self._require_expected(states, off)
        self._release(reached)
        self._retreat(fold)
        return PlaceResult(reached, contact, off, touch)

    @property
    def _base_from_part(self) -> pin.SE3:
        return self.base_from_surface * self.job.place.surface_from_part.se3()

    def _flange_at(self, height: float) -> pin.SE3:
        """Base from flange, with the part this far, m, above the place."""
        return self._base_from_part * from_parts((0.0, 0.0, height)) * self.job.grasp.flange_from_part.se3().inverse()

    def _depth(self) -> float:
        """How far, m, the flange is from where it is with the part in place, along the normal."""
        on_flange = (self._flange_at(0.0).inverse() * from_ur(self.arm.state().flange)).translation
        return float(on_flange @ self.job.grasp.flange_from_part.se3().rotation[:, 2])

    def _lift(self) -> None:
        plan = self.job.place
        above = self._flange_at(plan.approach)
        self.mover.line(above, plan.speed, TOUCHES, settle=False, near=NEAR_M, leaving=True)
        require_in_claw(self.claw, self.part, self.note, "on its way down; it may lie on its place")

    def _approach(self) -> None:
        self.progress(0.05, "approaching")
        # Not held before it: nobody would look at the surface again.
        way = self.mover.plan_to(self._flange_at(self.job.place.approach), "the approach pose")
        self.mover.follow(way)
        self.check()
        require_in_claw(self.claw, self.part, self.note, "before the descent")

    def _descend(self) -> None:
        """The fast part, to just above the place."""
        plan = self.job.place
        feel = plan.contact_travel if self.feel is None else self.feel
        self.progress(0.4, "descending")
        self.arm.zero_force()
        stopped = self.mover.line(
            self._flange_at(feel), plan.speed, TOUCHES, near=NEAR_M,
            force_limit=FAST_FORCE * plan.contact_force,
        )  # fmt: skip
        # At rest a lighter touch is felt than on the way; taken as zero, it would be pressed on without an end.
        if stopped or not np.linalg.norm(self.arm.state().wrench[:3]) <= plan.contact_force:
            height = self._depth()
            self._lift()
            raise RefusedError(
                f"the part touched something more than {1e3 * feel:.2f} mm above the place pose; it was "
                "lifted again, still held. Look what lies on the place, and whether the part is the right one",
                Measured("contact, above the place pose", 1e3 * height, "mm", most=1e3 * feel),
            )

    def _require_ready(self) -> None:
        try:
            self.ready()
        except CellError:
            self._lift()
            raise

    def _feel(self) -> tuple[bool, Sequence[ArmState]]:
        """The slow part: whether the part came into contact, and the arm's states on the way."""
        plan = self.job.place
        self.progress(0.6, "feeling for contact")
        below = self._flange_at(-plan.contact_travel)
        with self.arm.record() as states:
            contact = self.mover.line(below, plan.contact_speed, TOUCHES, force_limit=plan.contact_force, settle=False)
        return contact, states

    def _require_contact(self, contact: bool, off: float) -> None:
        if not contact:
            self._lift()
            raise RefusedError(
                f"no contact within {1e3 * self.job.place.contact_travel:.2f} mm of the place pose (the part stopped "
                f"{1e3 * off:+.2f} mm from it along the normal); it was lifted again, still held. "
                "Is the part the right one, and whole?",
                Measured("reached without contact", 1e3 * off, "mm"),
            )

    def _require_expected(self, states: Sequence[ArmState], off: float) -> TouchCheck | None:
        """Where the part touched first, beside where the scan says; None where the states on the way do not tell it."""
        at = self._flange_at(0.0).translation
        touched = felt_touch(states, at, self._base_from_part.rotation[:, 2])
        # It touched no lower than where it stands now.
        touch = TouchCheck(touched or TouchHeight(off, FELT_M), self.expected)
        if touched is None and touch.off <= REFUSED * touch.sigma:
            return None
        try:
            touch.require()
        except RefusedError:
            self._lift()
            raise
        return touch

    def _release(self, reached: pin.SE3) -> None:
        self.progress(0.8, "releasing")
        part = self.part
        require_in_claw(self.claw, part, self.note, "as it was set down")
        part.state, part.where = PartState.UNKNOWN, reached * self.job.grasp.flange_from_part.se3()
        # Whoever finds this run cut short here must not take the part as still held.
        self.note(part)
        self.claw.release()
        part.state = PartState.RELEASED
        self.note(part)
        self.mover.leave_part(part.where)

    def _retreat(self, fold: bool) -> None:
        self.progress(0.9, "retreating")
        self._lift()
        if fold:
            self.progress(0.95, "folding the arm")
            self.mover.fold()
        self.part.left = True


def note_part(context: StepContext, part: PartProgress) -> None:
    """Keep in the journal what has become of the part, and where it is, if that is known."""
    where = {} if part.where is None else {"base_from_part": to_ur(part.where).tolist()}
    context.note(part=part.state.value, **where)


def require_in_claw(claw: Claw, part: PartProgress, note: Callable[[PartProgress], None], when: str) -> None:
    """Raise `RefusedError` where the claw has lost the part that it held; that is noted."""
    if part.state is PartState.HELD and not claw.holding:
        part.state = PartState.UNKNOWN
        note(part)
        raise RefusedError(f"the claw lost the part {when}. Look where it is, and at the fingers")


def require_held(part: PartProgress) -> None:
    """Raise `RefusedError` where the part is not in the claw any more, as far as this program knows."""
    if part.state is not PartState.HELD:
        raise RefusedError(f"the part is {part.state.value}, not held: nothing is placed a second time")


def _run_step(workplace: Workplace, context: StepContext) -> PlaceResult:
    require_held(workplace.part)
    while True:
        held, pose = context.held_s, context.made(PlacePose)
        aim, mating = AimedPlace.of(workplace, pose).fitted(workplace, pose, context)
        look = _looked_again(workplace, pose, context)
        if look is not None and look.creep is not None:
            swept = context.made(SweepRecord), context.made(Reconstruction), context.made(BoardFix)
            pose = carried_on(workplace, *swept, look.creep)
        expected = expected_touch(aim.job, workplace.nominal, pose, workplace.repeatability)
        if mating is not None:
            expected = replace(expected, height=expected.height + mating.lift)
            pose = mating.stated(pose, workplace.job.place.surface_from_part.se3())
        context.safe_point()
        # Whoever has the run held may reach in, also in the middle of a look: then it is looked at again.
        if context.held_s == held:
            break
    # While the arm comes down; the laser is off.
    carriage = None if look is None or look.counted else workplace.devices.rail.check_zero()
    placing = Placing(
        aim.job, pose.base_from_surface, expected, mover=workplace.mover, arm=workplace.devices.arm,
        claw=workplace.devices.claw, part=workplace.part, check=context.check, progress=context.progress,
        note=lambda part: note_part(context, part),
        ready=lambda: None if carriage is None else carriage.wait(30.0), feel=felt_from(workplace, expected),
    )  # fmt: skip
    try:
        done = placing.put_down(not workplace.looks_after)
    except RefusedError:
        # Steps that the rail has lost explain a touch that comes early: they are told first.
        placing.ready()
        raise
    done = replace(done, look=look, pose=pose, mating=mating)
    if aim.allowed is not None:
        done = replace(done, allowed=aim.allowed, parts=len(workplace.parts_before.series.aside))
    for note in done.notes:
        context.note(text=note)
    return done


def aside_words(allowed: pin.SE3, parts: int) -> str:
    """For people, what so many parts had alike, and this one allows for."""
    x, y, _ = 1e3 * allowed.translation
    turn = 1e3 * pin.log3(allowed.rotation)[2]
    return (
        f"As {parts} parts before it came to lie ({x:+.2f}, {y:+.2f}) mm and {turn:+.1f} mrad aside, it was put down "
        "as far to the other side"
    )


@dataclass(frozen=True, eq=False)
class AimedPlace:
    """Where the part is put down so that it comes to lie in its place: `job` has it held so. `allowed` is by how much
    that is aside, None for nothing. `touching` are the places on the surface at which it may meet that then,
    surface_from_part."""

    job: Job
    allowed: pin.SE3 | None
    touching: tuple[pin.SE3, ...]

    @classmethod
    def of(cls, workplace: Workplace, pose: PlacePose) -> "AimedPlace":
        """By the parts of the batch before; straight at the place where they do not tell."""
        points, grasp, belongs = (
            part_points(workplace.nominal), workplace.job.grasp, workplace.job.place.surface_from_part.se3(),
        )  # fmt: skip
        unsure = grasp.covariance
        noise = expected_residual(workplace.job, workplace.repeatability, pose, points, unsure)
        allowed, slip = (
            workplace.parts_before.series.allowance(points, noise),
            workplace.parts_before.series.slip(points, noise),
        )
        if allowed is None:
            return cls(workplace.job, None, (belongs,))
        # Held aside, it touches at its place. One that slips as the claw opens touches aside, and slips into it.
        touching = (belongs, belongs * allowed.inverse()) if slip is None else (belongs * slip.inverse(),)
        return cls(job_with_grasp(workplace.job, grasp.flange_from_part.se3() * allowed, unsure), allowed, touching)

    def fitted(
        self, workplace: Workplace, pose: PlacePose, context: StepContext
    ) -> "tuple[AimedPlace, MatingGap | None]":
        """This, and the gap where the part touches first; straight at the place where it would not fit aside. Raises
        `RefusedError` where it does not fit at its place."""
        try:
            gaps = [_mated(workplace, pose, lies, context) for lies in self.touching]
        except RefusedError as refused:
            if self.allowed is None:
                raise
            context.note(text=f"parts before came to lie aside alike, which is not allowed for: {refused}")
            return AimedPlace(workplace.job, None, (workplace.job.place.surface_from_part.se3(),)).fitted(
                workplace, pose, context
            )
        if self.allowed is not None:
            context.note(text=aside_words(self.allowed, len(workplace.parts_before.series.aside)))
        return self, max(gaps, key=lambda gap: -np.inf if gap is None else gap.lift)


def _mated(workplace: Workplace, pose: PlacePose, lies: pin.SE3, context: StepContext) -> MatingGap | None:
    """The gap between the part as drawn, where it `lies` on the surface, and that as scanned; None without a mesh of
    the part or a scan. Raises `RefusedError` where they do not fit."""
    if workplace.part_mesh is None:
        return None
    context.progress(0.0, "holding the part's underside against the surface")
    try:
        cloud = context.made(Reconstruction).cloud
    except LookupError:
        # A kind of job that measures in another way.
        context.note(text="nothing was scanned: the part's underside was not held against the surface")
        return None
    found = scanned_gap(cloud, pose.base_from_surface, workplace.nominal, lies, workplace.part_mesh)
    if found is None:
        raise RefusedError(f"{APART}. {NEXT_STEP}")
    found.require(workplace.job.place.tolerance)
    return found


def carried_on(
    workplace: Workplace, sweep: SweepRecord, scan: Reconstruction, fix: BoardFix, creep: Creep
) -> PlacePose:
    """The place when the part touches it, of a surface that creeps, from the sweep freed of that. Raises what
    `inverted` raises, and `NotObservable` where too little is known of the rate."""
    crept = together(scan.by_poses, lambda lines, rows: creep.motions(scan.cloud, lines, rows, sweep.times))
    still = replace(scan, cloud=creep.undone(scan.cloud, sweep.times), by_poses=crept)
    plan = workplace.job.place
    until = APPROACH_S + plan.contact_travel / plan.contact_speed
    pose = creep.carried(
        inverted(workplace, sweep, still, fix), workplace.devices.clock.now() + until / workplace.pace.share
    )
    turn = np.kron(np.eye(2), pose.base_from_surface.rotation) / ([plan.tolerance] * 3 + [plan.tolerance_angle] * 3)
    excess = 3.0 * float(np.sqrt(np.linalg.eigvalsh(turn.T @ pose.covariance @ turn)[-1]))
    if not excess <= 1.0:
        raise NotObservable(
            f"the surface creeps against the arm: its place at the touch would be known to {excess:.2f} tolerances (3 "
            "sigma, allowed: 1). Let vehicle and surface come to rest, then run the job again",
            Measured("3 sigma of a place that creeps, in tolerances", excess, most=1.0),
        )
    return pose


def felt_from(workplace: Workplace, expected: TouchHeight) -> float:
    """How far, m, above the place the arm feels for contact: less where the part before touched as expected."""
    off, travel = workplace.parts_before.touch_off, workplace.job.place.contact_travel
    if off is None or abs(off) > ALIKE_M:
        return travel
    return min(travel, expected.height + REFUSED * float(np.hypot(expected.sigma, FELT_M)) + FREE_M)


def _looked_again(workplace: Workplace, pose: PlacePose, context: StepContext) -> SecondLook | None:
    """`RefusedError` when the surface is not where it was measured, or not bare; None where it was measured without a
    sweep."""
    fix = context.made(BoardFix)
    try:
        sweep, scan = context.made(SweepRecord), context.made(Reconstruction)
    except LookupError:
        # A kind of job that measures in another way.
        require_board_unmoved(workplace, fix, "before its place was measured", context.progress)
        return None
    lies = workplace.job.place.surface_from_part.se3()
    highest = highest_standing(scan.cloud, workplace.nominal, pose.base_from_surface, lies, workplace.job.grasp.size)
    found = require_bare(highest, workplace.job.place.tolerance)
    if found.seen < LEAST_SEEN:
        rest = f"{100 * found.seen:.0f} % of the surface below the part were scanned (at least {100 * LEAST_SEEN:.0f} %"
        context.note(text=f"{rest} tell): what stands on the rest is not seen. Widen scan.swath or scan.length")
    return require_in_place(workplace, fix, sweep, scan=scan, pose=pose, context=context)


# A part that may have touched the surface is not placed a second time by itself. The second look takes as long as a
# sweep: the step has what the one of the sweep has, and 180 s.
STEP = JobStep(Step("place", 300.0, on_failure=OnFailure.STOP), _run_step, PlaceResult, needs=(BoardFix, PlacePose))
