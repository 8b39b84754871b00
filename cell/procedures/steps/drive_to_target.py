"""Drive to the target: along the planned approach on odometry, then closed on the board that the camera sees."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import pinocchio as pin

from cell.config.job import BoardSection, Job
from cell.motion.collision import Body, CollisionError
from cell.motion.kinematics import HOME, Unreachable
from cell.procedures.arm.moves import Pace
from cell.procedures.arm.photograph import NEAR, BoardFix, look_pose, photo_pose
from cell.procedures.calibrate.interim import InterimCheck, interim_check
from cell.procedures.drive.driving import MAX_HEADING, Planar, drive_line, turn_to, wrap
from cell.procedures.drive.way import BACK_UP, Way, Whereabouts, left_at, next_step, speed_onto
from cell.procedures.steps.workplace import PHOTO_RATE_HZ, JobStep, Workplace
from cell.procedures.sweep.sweeping import check_lost_steps
from drivers.clock import Clock
from drivers.errors import CalibrationStale, Measured, RefusedError
from drivers.interfaces import Vehicle
from statemachine.runner import StepContext
from statemachine.step import Step

MAX_TRIES = 5
SETTLE_S = 0.3
"""The suspension's, after the vehicle has come to rest."""
UNSTEADY = 0.4
"""Share of the tolerance by which two photographs of a standing vehicle may differ before the picture is the cause."""
BESIDE = 0.25
"""A vehicle this near, m, to the line before another stop, that heads for it, backs along the line first."""
PASSED = 0.02
"""So far, m, from where it was sent a vehicle that does not see the board is brought there first: readings that came
late let it drive on, which the later ones tell."""


@dataclass(frozen=True, eq=False)
class VehicleArrival:
    """Where the vehicle came to stand, and the last photograph that shows it. Errors in m and rad.

    `driven` is false for an arm on a fixed frame, which was only looked at. `head` is what the look at the fine board
    before says of the scan head, None where nobody looked. `shared` is the photograph from there for the part before.
    """

    base_from_place: pin.SE3
    fix: BoardFix
    error_along: float
    error_across: float
    error_yaw: float
    photographs: int
    driven: bool = True
    head: InterimCheck | None = None
    shared: BoardFix | None = None

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "error_along_mm": round(1e3 * self.error_along, 2), "error_across_mm": round(1e3 * self.error_across, 2),
            "error_yaw_deg": round(math.degrees(self.error_yaw), 3), "photographs": self.photographs,
            **({} if self.driven else {"driven": False}), **({} if self.shared is None else {"shared": True}),
            **({} if self.head is None else {"interim": self.head.summary()}),
        }  # fmt: skip

    def words(self) -> str:
        """What became of the step where nothing drives, in words."""
        return (
            "no vehicle: the arm stands on a fixed frame and nothing was driven. By the board the station stands "
            f"{1e3 * self.error_along:.1f} mm along, {1e3 * self.error_across:.1f} mm across and "
            f"{math.degrees(self.error_yaw):.2f} deg from where the job has it"
        )


@dataclass(eq=False)
class TargetDrive:
    """One drive of the vehicle to the job's target: what it is driven with, and who is told and asked meanwhile.

    `photograph` gives the board in the base. `check` raises when the run is to end. `note` takes what is worth keeping.
    `hold` is called before each way, with the vehicle at rest: a paused run waits in it. `carried` are arm, tool and
    part as they stand, in the arm base: they are kept off the stations as the vehicle itself is. `pace` says how fast
    each way is driven, of the job's `approach.speed`. `photograph_of` gives the board of another stop.
    """

    job: Job
    vehicle_from_base: pin.SE3
    vehicle: Vehicle
    whereabouts: Whereabouts
    photograph: Callable[[], BoardFix]
    clock: Clock
    check: Callable[[], None]
    progress: Callable[[float, str], None]
    note: Callable[[str], None]
    hold: Callable[[], None] = lambda: None
    carried: Sequence[Body] = ()
    pace: Pace = field(default_factory=Pace)
    photograph_of: Callable[[BoardSection], BoardFix] | None = None
    _sent: Planar | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._way = Way(self.job, self.vehicle_from_base, self.whereabouts, self.carried)
        self._target = Planar.of(self.job.approach.target.se3())

    def to_target(self) -> VehicleArrival:
        """Bring the vehicle to the job's target to within its tolerance and brake it there.

        The arm stands in its looking pose already and the vehicle is enabled. On odometry alone it goes no further than
        the staging pose, and only when `whereabouts` knows where it stands. From another stop it backs first to the
        start of the line there.
        Raises `RefusedError` when the vehicle neither sees the board nor knows where it stands, when its way leads too
        close to the station, and when the tolerance is not met after nine photographs.
        """
        self._require_known_place()
        self._leave_other_stops()
        staging = Planar.of(self.job.approach.staging.se3())
        if (staging.inverse() * self.whereabouts.pose()).x < 0:
            self.progress(0.1, "driving on odometry")
            self._go(staging)
        approach = self.job.approach
        for count in range(1, 2 * MAX_TRIES):
            self.progress(min(0.9, 0.3 + 0.15 * count), "looking at the board")
            self.clock.sleep(SETTLE_S)
            fix = self._look_again()
            base_from_place = fix.base_from_board * self.job.place_from_board.inverse()
            error = self._target.inverse() * self._place_from_vehicle(fix)
            near = abs(error.x) < 0.8 * approach.tolerance and abs(error.y) < 0.8 * approach.tolerance
            if near and abs(error.yaw) < 0.5 * approach.tolerance_angle:
                self.vehicle.brake()
                return VehicleArrival(base_from_place, fix, error.x, error.y, error_yaw=error.yaw, photographs=count)
            # Not after the last: nobody would see where that brought it.
            if count < 2 * MAX_TRIES - 1:
                self._correct(error, near)
        self.vehicle.brake()
        remedy = self._remedy_of_a_miss()
        raise _off_target(error, self.job, fix, who="the vehicle", after=f" after {count} photographs", remedy=remedy)

    def _require_known_place(self) -> None:
        """By the board, where it is in sight already, or by odometry."""
        self.progress(0.05, "looking whether the board is in sight already")
        try:
            self._photograph()
        except RefusedError as unseen:
            try:
                self.whereabouts.pose()
            except RefusedError as unknown:
                if self._seen_from_another_stop():
                    return
                text = f"{unknown}; and it does not see the board: {unseen}. {next_step(self.job)}"
                raise RefusedError(text).showing(*unseen.numbers, seen=unseen.seen) from unknown

    def _seen_from_another_stop(self) -> bool:
        """Whether the board of another stop is in sight, by which it is known where the vehicle stands."""
        if (photograph := self.photograph_of) is None:
            return False
        for stop in self.job.other_stops:
            with suppress(RefusedError):
                fix = photograph(stop.board)
                base_from_stop = fix.base_from_board * stop.board.place_from_board.se3().inverse()
                seen = stop.place_from_stop * (self.vehicle_from_base * base_from_stop).inverse()
                self.whereabouts.see(Planar.of(seen))
                self.note(f"the vehicle stands before stop {stop.name}, by its board")
                return True
        return False

    def _leave_other_stops(self) -> None:
        """Back, from before another stop, to the start of the line there."""
        for stop in self.job.other_stops:
            start = left_at(stop)
            stands = start.inverse() * self.whereabouts.pose()
            if stands.x > PASSED and abs(stands.y) < BESIDE and abs(stands.yaw) < MAX_HEADING:
                self.progress(0.1, f"leaving stop {stop.name}")
                self._go(start)

    def _correct(self, error: Planar, near: bool) -> None:
        """Drive what `error`, the vehicle's pose in its target's frame, asks for; `near` where it only has to turn."""
        if near:
            self.hold()
            self._way.require_turn(self._target.yaw)
            turn_to(self.vehicle, self.whereabouts, self._target.yaw, self.clock, self.check)
        elif abs(error.y) > 0.8 * self.job.approach.tolerance and error.x > -0.5 * BACK_UP:
            self.progress(0.5, "backing up")
            self._go(self._target * Planar(-BACK_UP, 0.0, 0.0))
            self._go(self._target)
        else:
            self._go(self._target)

    def _go(self, goal: Planar) -> None:
        self._sent = goal
        self.hold()
        share = self.pace.share
        self._way.require_line(goal, share)
        speed = speed_onto(self.job, goal.inverse() * self.whereabouts.pose()) * share
        drive_line(self.vehicle, self.whereabouts, goal, speed=speed, clock=self.clock, check=self.check)

    def _photograph(self) -> BoardFix:
        fix = self.photograph()
        if (doubt := self.whereabouts.see(self._place_from_vehicle(fix))) is not None:
            self.note(doubt)
        return fix

    def _look_again(self) -> BoardFix:
        """Where the board was to be seen; from where the vehicle was sent, if it is not."""
        way_so_far = self.whereabouts.way
        try:
            try:
                return self._photograph()
            except RefusedError:
                if self._sent is None or abs((self._sent.inverse() * self.whereabouts.pose()).x) < PASSED:
                    raise
                self.note(
                    "the board is not seen, and the vehicle stands elsewhere than it was sent: it is brought there"
                )
                self._go(self._sent)
                self.clock.sleep(SETTLE_S)
                return self._photograph()
        except RefusedError as unseen:
            raise RefusedError(
                f"after {way_so_far:.2f} m on odometry the board is not seen from where it should be: {unseen}. Look "
                "where the vehicle stands and bring it where it sees the board with `cell jog vehicle`; had it stood "
                "at its start, and do its wheels slip?"
            ).showing(*unseen.numbers, seen=unseen.seen) from unseen

    def _remedy_of_a_miss(self) -> str:
        """What to look at where the tolerance was not met: two photographs of the braked vehicle tell."""
        approach = self.job.approach
        one, two = (self._place_from_vehicle(self.photograph()) for _ in range(2))
        apart, turned = max(abs(one.x - two.x), abs(one.y - two.y)), abs(wrap(one.yaw - two.yaw))
        if max(apart / approach.tolerance, turned / approach.tolerance_angle) <= UNSTEADY:
            return "check the floor and the wheels"
        return (
            f"while it stands, the board's place changes by {1e3 * apart:.1f} mm and {math.degrees(turned):.2f} deg "
            "from photograph to photograph: see whether warm air shimmers before the camera, a fan blows, or board or "
            "camera are loose; the wheels are not the cause"
        )

    def _place_from_vehicle(self, fix: BoardFix) -> Planar:
        return Planar.of((self.vehicle_from_base * fix.base_from_board * self.job.place_from_board.inverse()).inverse())


def stand_at_target(
    job: Job, vehicle_from_base: pin.SE3, vehicle: Vehicle, whereabouts: Whereabouts, photograph: Callable[[], BoardFix]
) -> VehicleArrival:
    """What `TargetDrive` is for an arm on a fixed frame: look whether the station stands where the job has it. Raises
    `RefusedError` with how far it is off when that is more than the job's tolerance."""
    try:
        fix = photograph()
    except RefusedError as unseen:
        raise RefusedError(
            f"the arm stands on a fixed frame and does not see the board: {unseen}. Bring the station to where "
            "approach.target has it, or correct approach.target"
        ).showing(*unseen.numbers, seen=unseen.seen) from unseen
    found, near = _arrived(job, vehicle_from_base, whereabouts, fix)
    if not near:
        error = Planar(found.error_along, found.error_across, found.error_yaw)
        raise _off_target(
            error, job, fix, "the arm, on its fixed frame,", "", remedy="move the station, or correct approach.target"
        )
    vehicle.brake()
    return replace(found, driven=False)


def _arrived(
    job: Job, vehicle_from_base: pin.SE3, whereabouts: Whereabouts, fix: BoardFix,
    note: Callable[[str], None] = lambda text: None,
) -> tuple[VehicleArrival, bool]:  # fmt: skip
    """Where a vehicle that was not driven stands by one photograph, and whether that is within the job's tolerance."""
    base_from_place = fix.base_from_board * job.place_from_board.inverse()
    stands = Planar.of((vehicle_from_base * base_from_place).inverse())
    if (doubt := whereabouts.see(stands)) is not None:
        note(doubt)
    error = Planar.of(job.approach.target.se3()).inverse() * stands
    most, most_angle = job.approach.tolerance, job.approach.tolerance_angle
    near = abs(error.x) <= most and abs(error.y) <= most and abs(error.yaw) <= most_angle
    return VehicleArrival(base_from_place, fix, error.x, error.y, error_yaw=error.yaw, photographs=1), near


def _off_target(error: Planar, job: Job, fix: BoardFix, who: str, after: str, remedy: str) -> RefusedError:
    most, most_angle = 1e3 * job.approach.tolerance, math.degrees(job.approach.tolerance_angle)
    along, across, turned = 1e3 * error.x, 1e3 * error.y, math.degrees(error.yaw)
    return RefusedError(
        f"{who} stands {along:.1f} mm along, {across:.1f} mm across and {turned:.2f} deg from its target{after}, "
        f"allowed {most:.0f} mm and {most_angle:.1f} deg; {remedy}",
        Measured("vehicle off its target, along", along, "mm", most=most),
        Measured("vehicle off its target, across", across, "mm", most=most),
        Measured("vehicle turned off its target", turned, "deg", most=most_angle),
    ).showing(seen={"frame": fix.frames[-1], "view": fix.views[-1]} if fix.frames else None)


def _run_step(workplace: Workplace, context: StepContext) -> VehicleArrival:
    """The arm to its looking pose first, with the vehicle braked."""
    if workplace.needs_part and not workplace.devices.claw.holding:
        raise RefusedError(
            f"the claw holds no part: put the part of job {workplace.job.job.name} into it, or see whether it was "
            "placed already"
        )
    if workplace.part.state.untaken and workplace.devices.claw.holding:
        raise RefusedError(
            f"the claw holds a part, and job {workplace.job.job.name} takes one that is "
            f"{workplace.part.state.value}: take it out of the claw"
        )
    vehicle = workplace.devices.vehicle
    if trouble := vehicle.state().trouble:
        context.note(text=f"the vehicle reported before the run: {'; '.join(trouble)}; taking command clears it")
    if warnings := vehicle.state().warnings:
        context.note(text=f"the vehicle warns: {'; '.join(warnings)}")
    vehicle.recover()
    workplace.devices.forget_ambient_light()
    head = _checked(workplace, context)
    if (stands := workplace.parts_before.arrival) is not None and workplace.whereabouts.still:
        vehicle.brake()
        context.note(text="the vehicle stands as for the part before: neither driven nor photographed again")
        return replace(stands, photographs=0, head=head)
    if head is None and not workplace.whereabouts.anchored:
        workplace.mover.to_joints(HOME)
    workplace.whereabouts.enter(workplace.job)
    workplace.devices.target_camera.configure(workplace.config.target_camera.photo_exposure, PHOTO_RATE_HZ)
    if (stays := _still_there(workplace, context)) is not None:
        return replace(stays, head=head)
    context.progress(0.0, "arm to the looking pose")
    camera = workplace.calibration.target.flange_from_camera
    look = look_pose(workplace.config, workplace.job, workplace.board, camera)
    workplace.mover.to_as_from(HOME, look, "the looking pose")
    workplace.devices.interlocks.may_drive_with(f"the looking pose of job {workplace.job.job.name}", look)
    if not workplace.config.vehicle.DRIVES:
        stand = workplace.config.arm.vehicle_from_base.se3()
        context.progress(0.3, "nothing to drive: looking whether the station stands where the job has it")
        arrival = stand_at_target(workplace.job, stand, vehicle, workplace.whereabouts, workplace.photograph)
        context.note(text=arrival.words())
        return replace(arrival, head=head)
    vehicle.enable()
    drive = TargetDrive(
        workplace.job, workplace.config.arm.vehicle_from_base.se3(), vehicle, whereabouts=workplace.whereabouts,
        photograph=workplace.photograph, clock=workplace.devices.clock, check=context.check, progress=context.progress,
        note=lambda text: context.note(text=text), hold=context.safe_point, carried=workplace.mover.solids(),
        pace=workplace.mover.pace, photograph_of=workplace.photograph_of,
    )  # fmt: skip
    return replace(drive.to_target(), head=head)


def _still_there(workplace: Workplace, context: StepContext) -> VehicleArrival | None:
    """Where the vehicle stands, by a photograph from where the part before had its own; None, for it to be driven,
    where it has moved, or the board shows it off its target or not at all."""
    before = workplace.parts_before.board
    if before is None or not workplace.whereabouts.still:
        return None
    context.progress(0.3, "looking from where the arm photographed the board before")
    goal = photo_pose(
        workplace.job, workplace.board, before.base_from_board, workplace.calibration.target.flange_from_camera
    )
    stand = workplace.config.arm.vehicle_from_base.se3()
    try:
        workplace.mover.to(goal, "the photograph pose", within=NEAR)
        workplace.devices.clock.sleep(SETTLE_S)
        fix = workplace.photograph()
        found, near = _arrived(workplace.job, stand, workplace.whereabouts, fix, lambda text: context.note(text=text))
    except RefusedError as unseen:
        context.note(text=f"the board is not seen from where it was for the part before: {unseen}")
        return None
    if near:
        workplace.devices.vehicle.brake()
        return replace(found, driven=workplace.config.vehicle.DRIVES)
    x, y = 1e3 * found.error_along, 1e3 * found.error_across
    context.note(text=f"the vehicle stands ({x:.1f}, {y:.1f}) mm off its target now, and is driven there again")
    return None


def _checked(workplace: Workplace, context: StepContext) -> InterimCheck | None:
    """Whether the scan head is where its calibration has it; None where that is not wanted or, with a note, not seen.

    Once in a run: when the step is done again, the vehicle may stand before a station that the arm does not know yet.
    Raises `RefusedError` where the head has moved too far for this job, or the board is not seen, and `DeviceFault`
    where the rail has lost steps.
    """
    if workplace.looked or not workplace.config.calibration.each_job:
        return workplace.interim
    if workplace.look_before(context) is not None:
        return None
    try:
        found = interim_check(
            workplace.config, workplace.devices, workplace.mover, workplace.calibration, workplace.job,
            check=context.check, progress=lambda text: context.progress(0.0, text), keep=workplace.frames.keep,
        )  # fmt: skip
    except (CalibrationStale, Unreachable, CollisionError) as error:
        text = f"whether the scan head has moved since the calibration is not seen: {error}"
        context.note(text=f"{text}. Until it is, `cell calibrate verify` tells")
        workplace.looked = True
        return None
    if found.matters:
        # A carriage that lost steps has the camera aside as well.
        check_lost_steps(workplace.devices)
    found.require()
    workplace.interim, workplace.looked = found, True
    # Whatever ends the step from here on, these pictures do not show it.
    workplace.frames.begin()
    for note in found.notes:
        context.note(text=note)
    return found


STEP = JobStep(Step("drive_to_target", 300.0, 1, ("DeadlineError",)), _run_step, VehicleArrival)
