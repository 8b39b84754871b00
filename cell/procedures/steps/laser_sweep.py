"""The laser sweep: to the scan pose, settle, laser on, constant-velocity sweep, laser off; as often as the job asks.

Before a part is put down or taken, the way back is a second look, in few lines: does the surface still lie there? That
needs the lateness of the camera's stamps (`cell calibrate timing`); without it, the step that goes down looks.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import changed, doubt_of, link_of
from cell.config.cell_config import CellConfig
from cell.config.job import LONGEST_SWEEP_S, ScanSection, SwathSection
from cell.measure.calibration import ScanCalibration
from cell.measure.calibration.drift.reference_plate import PlateLine, Pointing
from cell.measure.calibration.drift.reference_plate import pointing as pointing_since
from cell.measure.calibration.drift.slip import LARGEST_M, Slip, slip_since
from cell.measure.calibration.drift.timing import StampTiming
from cell.procedures.ambient import MOST_WHITE, TRIES, bearable, require_line, shorten
from cell.procedures.arm.photograph import BoardFix, scan_plans
from cell.procedures.calibrate.reference_plate import configure_fast, require_edge, require_reference_plate
from cell.procedures.frame_store import Cut
from cell.procedures.steps.board_photo import require_board_unmoved
from cell.procedures.steps.workplace import JobStep, Workplace
from cell.procedures.sweep.stored_sweep import FILE, SweepRecord, save_sweep
from cell.procedures.sweep.swath import MAX_LOST_FRACTION, Swath, SweepCollector, SweepErrors, warm_up
from cell.procedures.sweep.sweeping import arm_sweep, check_lost_steps, home_rail, rail_sweep
from drivers.errors import CalibrationStale
from drivers.interfaces import Frame
from statemachine.runner import StepContext
from statemachine.step import Step

UNSEEN_BY_LIGHT = (
    "whether the scan head has slipped since it was looked at over the fine board is not seen: ambient light makes the "
    "edge of the plate on the claw as bright as the laser's line"
)
SHIFT_SHARE = 0.25
"""Share of the place's tolerance by which the unknown of its times may shift a sweep. Replies that are all late shift
it to one side without any scatter; what else the place may be off by has the other three quarters."""
LINES = 48
"""Of a look at a strip once more. Enough for a vehicle that rocks to average out: with 32, a sweep that was repeated at
half its speed showed a rocking of 4 Hz as a slow motion: once for each of these lines, or nearly."""
MOST_LOST = 0.5
"""Share of its frames: a comparison misses none of them, and says what is left of it."""
HURRY, IN_TIME = 2.0, 3.0
"""So many times as fast as in the sweep the rail goes, where it can: few lines need few pictures. Faster where it is
known how late the camera's stamps come."""
ROOM_M = 1e-3
"""Left of the travel beside what it takes to gain speed."""


def laser_sweep(
    workplace: Workplace, base_from_surface: pin.SE3, head: ScanCalibration, scan: ScanSection, *,
    keep_frame: Callable[[Frame, Cut | None], None], check: Callable[[], None], progress: Callable[[float, str], None],
    sweeping: Callable[[SweepCollector, pin.SE3], None] = lambda collector, base_from_surface: None,
    most_lost: float = MAX_LOST_FRACTION, counted: bool = True, back: bool = False,
) -> SweepRecord:  # fmt: skip
    """Sweep the scan head over each strip of `scan`, by rail or arm as `scan.mode` says; the other way if `back`.

    `sweeping` is told where the surface is taken to be beside who takes the frames. `check` raises when the run is to
    end. Whether the rail has lost steps is looked at unless `counted` is False: whoever says so does it.

    Raises what `rail_sweep` and `arm_sweep` raise, and `DeviceFault` (rail.lost_steps).
    """
    devices, config = workplace.devices, workplace.config
    home_rail(devices, progress)
    plans = scan_plans(config, workplace.job.model_copy(update={"scan": scan}), base_from_surface, head)
    errors = SweepErrors(
        workplace.repeatability, config.calibration.rail_sigma,
        (1.0 if back else SHIFT_SHARE) * workplace.job.place.tolerance,
        rate=devices.clock.rate, late=math.hypot(config.scan_camera.late, config.rail.late),
        timing=times_known(workplace.calibration.scan, config)[0], lost=most_lost,
    )  # fmt: skip
    sweep, geometry = arm_sweep if scan.mode == "arm" else rail_sweep, head.geometry()
    progress(0.01, "preparing")
    warm_up(geometry)
    swaths, notes = [], list[tuple[str, ...]]()
    for k, plan in enumerate(plan.back if back else plan for plan in plans):
        name = f"sweep {k + 1} of {len(plans)}"

        def notify(fraction: float, text: str, k: int = k, name: str = name) -> None:
            progress((k + fraction) / len(plans), f"{name}: {text}" if len(plans) > 1 else text)

        notify(0.02, "arm to the scan pose")
        for _ in range(TRIES):
            check()
            collector = SweepCollector(geometry, scan, keep_frame, notify)
            sweeping(collector, base_from_surface)
            swath = sweep(plan, workplace.mover, devices, errors, collector)
            if collector.whitest is None or collector.white <= MOST_WHITE * len(collector.times):
                break
            shorten(devices.scan_camera, bearable(collector.whitest))
        if collector.notes:
            shares = np.array(collector.counts) / geometry.camera.height
            line = swath.middle_profile
            require_line(shares, swath.middle, line.amplitude[line.valid])
        swaths.append(swath)
        notes.append(collector.notes)
    looked = counted and scan.mode == "rail"
    lost = check_lost_steps(devices, progress) if looked else ()
    return SweepRecord(tuple(swaths), doubts=(*lost, *chain.from_iterable(notes)))


def in_few_lines(
    workplace: Workplace, over: pin.SE3, head: ScanCalibration, before: Swath, *, keep: str, check: Callable[[], None],
    progress: Callable[[float, str], None], back: bool = False, counted: bool = False,
) -> SweepRecord:  # fmt: skip
    """Sweep the job's last strip, swept `before`, once more in about `LINES` lines, the other way if `back`. `over` is
    base_from_surface, `keep` what its frames are kept as. Raises what `laser_sweep` raises."""
    scan = workplace.job.scan
    few = sparse(workplace, scan.swath[-1], before)
    # A camera of a few frame rates takes all the lines.
    rate = configure_fast(workplace.devices, few.exposure, (few.frame_rate, scan.frame_rate))
    return laser_sweep(
        workplace, over, head, few.model_copy(update={"frame_rate": rate}), most_lost=MOST_LOST, back=back,
        keep_frame=partial(workplace.frames.keep, keep), check=check, progress=progress, counted=counted,
    )  # fmt: skip


def sparse(workplace: Workplace, strip: SwathSection, before: Swath) -> ScanSection:
    """The `strip` that was swept `before`, in about `LINES` lines: by the rail faster, where there is room to gain
    speed; by the arm no faster, since a repetition is slower."""
    scan, rail = workplace.job.scan, workplace.config.rail
    speed = min(scan.speed, pace(before))
    if scan.mode == "rail":
        # As much room as beyond the ends of the sweep.
        room = 0.5 * (rail.travel[1] - rail.travel[0] - scan.length) - ROOM_M
        hurry = HURRY if times_known(workplace.calibration.scan, workplace.config)[0] is None else IN_TIME
        speed = max(speed, min(hurry * speed, rail.max_speed, math.sqrt(2.0 * rail.acceleration * max(room, 0.0))))
    rate = min(scan.frame_rate, max(1.0, LINES * speed / scan.length))
    return scan.model_copy(update={"frame_rate": rate, "speed": speed, "swath": (strip,)})


def pace(swath: Swath) -> float:
    """How fast, m/s, the scan head went."""
    ways = np.linalg.norm(swath.flanges[-1, :3, 3] - swath.flanges[0, :3, 3]) + abs(swath.rail[-1] - swath.rail[0])
    return float(ways / (swath.times[-1] - swath.times[0]))


def slowed_down(scan: ScanSection, attempt: int) -> ScanSection:
    """The sweep of the `attempt` (from 1): each repetition half as fast with half the frames, the lines as close. What
    loses frames most often is a machine that does not keep up with them."""
    seconds = len(scan.swath) * scan.length / scan.speed
    # No slower than the step has time for.
    share = max(0.5 ** (attempt - 1), min(1.0, seconds / LONGEST_SWEEP_S))
    return scan.model_copy(update={"speed": share * scan.speed, "frame_rate": max(1.0, share * scan.frame_rate)})


def _run_step(workplace: Workplace, context: StepContext) -> SweepRecord:
    """Not swept again what an earlier run has swept, if the board has not moved."""
    fix = context.made(BoardFix)
    # One that is to be done again holds no more, should this run be cut short now.
    (workplace.folder / FILE).unlink(missing_ok=True)
    if context.attempt > 1:
        # After a fault the arm's base may stand elsewhere.
        require_board_unmoved(
            workplace, fix, "before the fault that ended the sweep", lambda _, text: context.progress(0.0, text)
        )
        context.note(text="the board has not moved since the fault")
    # Used once: whoever has it swept again was not content with it.
    earlier, workplace.earlier = workplace.earlier, None
    if earlier is not None:
        try:
            sweep = earlier.confirmed_by(fix)
        except CalibrationStale as moved:
            context.note(text=f"{moved}: sweeping again")
        else:
            earlier.copy_to(workplace.folder)
            for note in (f"the board has not moved: the sweep of run {earlier.folder.name} holds", *sweep.notes):
                context.note(text=note)
            return sweep
    sweep = _sweep(workplace, context, fix)
    save_sweep(workplace.folder, sweep, fix, workplace.frames.settle())
    return sweep


def _sweep(workplace: Workplace, context: StepContext, fix: BoardFix) -> SweepRecord:
    head = workplace.calibration.scan
    home_rail(workplace.devices, context.progress)
    look = workplace.look_before(context)
    if look is None:
        (pointing, slip), looked_s = seen_on_plate(workplace, context), 0.0
    else:
        pointing, slip, looked_s = look.pointing, look.slip, workplace.devices.clock.now() - look.at
        context.note(text=f"the scan head was looked at {looked_s:.0f} s ago, for a part before this one")
    timing, doubts = times_known(head, workplace.config)
    if pointing is not None:
        head = head.pointed(pointing, workplace.config.laser.exit_point)
    over = workplace.base_from_surface(fix)
    # Stamps that come late shift sweep and way back to either side: unless it is known by how much, that is blunt.
    again = workplace.looks_again and timing is not None and workplace.job.scan.mode == "rail"
    record = laser_sweep(
        workplace, over, head, slowed_down(workplace.job.scan, context.attempt),
        check=context.check, progress=context.progress, keep_frame=partial(workplace.frames.keep, "stripe"),
        sweeping=workplace.sweeping, counted=not again,
    )  # fmt: skip
    rest = workplace.devices.interlocks.situation.last if workplace.job.scan.mode == "rail" else None
    back = None if not again else in_few_lines(
        workplace, over, head, record.swaths[-1], keep="second-look", check=context.check, back=True, counted=True,
        progress=lambda share, text: context.progress(0.9, f"whether the surface lies still: {text}"),
    )  # fmt: skip
    lost = () if back is None else back.doubts
    blinded = (UNSEEN_BY_LIGHT,) if workplace.devices.bright else ()
    doubts = (*record.doubts, *lost, *unwatched(head.witness), *blinded, *doubts, *workplace.notes)
    record = replace(
        record, pointing=pointing, slip=slip, doubts=doubts, rest=rest, back=back, held_s=context.held_s,
        looked_s=looked_s,
    )  # fmt: skip
    for note in record.notes:
        context.note(text=note)
    return record


def head_at(workplace: Workplace, sweep: SweepRecord) -> ScanCalibration:
    """The scan head with the laser where it pointed before this sweep."""
    head = workplace.calibration.scan
    return head if sweep.pointing is None else head.pointed(sweep.pointing, workplace.config.laser.exit_point)


def times_known(head: ScanCalibration, config: CellConfig) -> tuple[StampTiming | None, tuple[str, ...]]:
    """How late the camera's stamps come, if that was measured with the settings of now; and for people what of the
    camera's times is not known."""
    timing, doubts = head.timing, list(head.unread)
    if timing is not None and (doubt := doubt_of(timing, config)):
        doubts.append(
            f"how late the scan camera's time stamps come is kept since {timing.date}, but {doubt}; the sweep goes on "
            "with scan_camera.late. Run `cell calibrate timing`"
        )
        timing = None
    seen = timing is not None or (head.shutter is not None and not changed(head.shutter.link, link_of(config)))
    if not seen:
        doubts.append(
            "whether the scan camera has a rolling shutter is not known: nobody looked with these settings of it, and "
            "a sweep does not show it. Run `cell calibrate timing`"
        )
    return timing, tuple(doubts)


def unwatched(witness: PlateLine | None) -> tuple[str, ...]:
    """For people, what a look at the plate on the claw cannot tell, of which the calibration saw this."""
    if witness is None:
        return (
            "whether the laser has turned or the scan head has slipped since the calibration is not seen: it looked at "
            "no plate on the claw. Mount one and configure laser.witness",
        )
    if witness.edge is None:
        return (
            "whether the scan head has slipped since the calibration is not seen: the plate on the claw has no edge "
            "that the laser's line passes within 10 mm of laser.witness",
        )
    return ()


def seen_on_plate(workplace: Workplace, context: StepContext) -> tuple[Pointing | None, Slip | None]:
    """Where the laser points now, and how far the head has slipped; None where the calibration saw no plate, or no edge
    of it, and of the slip where ambient light is bright. `RefusedError` when anything was knocked."""
    head, config, devices, keep = workplace.calibration.scan, workplace.config, workplace.devices, workplace.frames.keep
    before = head.witness
    if before is None:
        return None, None
    context.progress(0.0, "looking where the laser points")
    seen = require_reference_plate(config, devices, keep)
    pointing = pointing_since(
        before, seen, head.camera, plane=head.light_plane, exit_point=config.laser.exit_point, confirmed=head.confirmed
    )
    if before.edge is None or devices.bright:
        return pointing, None
    context.progress(0.005, "looking whether the scan head has slipped")
    seen = require_edge(config, devices, keep, before, seen)
    slip = slip_since(before, seen, head.camera, head.light_plane, head.rail_direction)
    if slip.size > LARGEST_M:
        check_lost_steps(devices, context.progress)
    slip.require()
    return pointing, slip


STEP = JobStep(Step("laser_sweep", 180.0, 2, ("DeadlineError",)), _run_step, SweepRecord, needs=(BoardFix,))
