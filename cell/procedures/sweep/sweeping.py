"""A sweep by the rail, or by the arm alone: the other stands still, under the lit laser.

By the arm every line has a flange pose of its own, between the states that the arm reported. What is not known of the
two clocks shifts the whole sweep along its way; round trips bound it. How long the arm held a state back before it put
its time on it cannot be known.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cell.devices.devices import Devices
from cell.devices.simulated.following import MOST_SCATTER
from cell.measure.geometry.poses import from_parts, from_ur
from cell.motion.trajectory import LONGEST_GAP_S, FlangeTrack, Trajectory
from cell.procedures.ambient import meet_light
from cell.procedures.arm.moves import Mover
from cell.procedures.arm.photograph import ScanPlan
from cell.procedures.sweep.swath import RailPath, Swath, SweepCollector, SweepErrors, TimeBound, shift_by_times
from drivers.clock import ClockMap
from drivers.errors import CellError, DeviceFault
from drivers.interfaces import ArmState, Motion, Rail, Sweep, Vector

RUN_UP_S = 0.7
"""Seconds at full speed by which the line is longer at both ends: the arm gains its speed and its wobble dies out."""
LATENCY_S = 0.002
"""What the time of a state may be off, 1 sigma, wall seconds, beside what round trips leave open: a controller's cycle,
since nothing tells where in it the joints were read."""
JITTER_S = 0.0003
"""The same from one line to the next."""
UNCHECKED = (
    "whether the rail lost steps in the sweep is not seen: this make of rail, or its rail.reference_mode, does not "
    "show its reference switch"
)


def home_rail(devices: Devices, progress: Callable[[float, str], None] = lambda share, text: None) -> None:
    """Home the rail where this program has not: a zero that another one found is not trusted."""
    if not devices.rail.state().homed_here:
        progress(0.0, "homing the rail")
        devices.rail.home().wait(60.0)


def check_lost_steps(
    devices: Devices, progress: Callable[[float, str], None] = lambda share, text: None
) -> tuple[str, ...]:
    """Look whether the rail has lost steps, which its readings do not show: they are its counter's. For people, that
    this cannot be seen. Raises `DeviceFault` (rail.lost_steps)."""
    progress(0.99, "looking whether the rail has lost steps")
    if (check := devices.rail.check_zero()) is None:
        return (UNCHECKED,)
    check.wait(30.0)
    return ()


@contextmanager
def beside_arm(mover: Mover, rail: Rail, begin: Callable[[], Motion]) -> Iterator[None]:
    """What the rail begins, it does while the arm moves; both are still in the end. Held before it, not meanwhile."""
    mover.hold()
    motion = begin()
    hold, mover.hold = mover.hold, lambda: None
    try:
        yield
    except BaseException:
        with suppress(CellError):
            rail.stop()
        raise
    finally:
        mover.hold = hold
    motion.wait(60.0)


def arm_sweep(plan: ScanPlan, mover: Mover, devices: Devices, errors: SweepErrors, collector: SweepCollector) -> Swath:
    """Move the scan head over the placement area and pair every profile with the flange's pose.

    Raises `DeviceFault` when more than `errors.lost` of the frames were lost, none came from the planned stretch, the
    arm's states have gaps or it moved unevenly between them, or the times of arm or camera are not known well enough;
    whatever happens, the arm is stopped before the error goes on.
    """
    scan, arm, camera = collector.scan, devices.arm, devices.scan_camera
    along, length = _straight(plan)
    devices.rail.move_to(plan.rail_start).wait(30.0)
    run_up = RUN_UP_S * scan.speed * along
    start, stop = from_parts(-run_up) * plan.base_from_flange, from_parts(run_up) * plan.base_from_flange_end
    way, line = mover.plan_line(start, stop, scan.speed)
    mover.follow(way)
    rail = devices.rail.state().position
    camera.configure(scan.exposure, scan.frame_rate)
    collector.notes = meet_light(devices)
    clocks = ClockMap()
    clocks.add([arm.latch_clock()])
    # Before anything is lit and moved in vain.
    shift_by_times([TimeBound(arm.name, "arm", clocks.uncertainty)], scan.speed, errors)
    states = _follow_lit(line, mover, devices, collector)
    clocks.add([arm.latch_clock()])
    track = FlangeTrack(arm.name, states, clocks, LONGEST_GAP_S * max(1.0, errors.rate))
    times = np.array(collector.times)
    lines, flanges, done, uneven = _on_the_line(track, times, plan, errors)
    swath = _swath_of(collector, lines, camera.name, errors)
    if len(lines) < 3:
        raise DeviceFault(
            arm.name, "arm.sweep_too_short",
            f"only {len(lines)} profiles were taken on the planned {1e3 * length:.1f} mm", recoverable=True,
            hint="Lower scan.speed or raise scan.frame_rate.",
        )  # fmt: skip
    steady = np.polynomial.Polynomial.fit(times[lines], done, 1)
    known = TimeBound(arm.name, "arm", max(clocks.bound_at(float(times[k])) for k in (lines[0], lines[-1])))
    shift, variance = shift_by_times([known, TimeBound.of(camera)], scan.speed, errors)
    own = scan.speed * JITTER_S * errors.rate * along
    return swath(
        times=times[lines], flanges=flanges, rail=np.full(len(lines), rail), line_spread=np.tile(own, (len(lines), 1)),
        covariance=_covariance(errors, along, (scan.speed * LATENCY_S * errors.rate) ** 2 + variance),
        lost=collector.lost + uneven, residual=float(np.std(done - steady(times[lines]))), shift=shift,
    )  # fmt: skip


def _straight(plan: ScanPlan) -> tuple[Vector, float]:
    """Direction (3,), base axes, and length, m, of the arm's planned line."""
    shift = plan.base_from_flange_end.translation - plan.base_from_flange.translation
    length = float(np.linalg.norm(shift))
    return shift / length, length


def _follow_lit(line: Trajectory, mover: Mover, devices: Devices, collector: SweepCollector) -> Sequence[ArmState]:
    """Have the arm follow the line under the lit laser while frames are taken; its states meanwhile."""
    arm, laser, camera, clock = devices.arm, devices.laser, devices.scan_camera, devices.clock
    # The laser within all else: it goes off first, however long arm and camera take to end what they send.
    with devices.interlocks.purpose("sweep"), arm.record() as states, camera.stream() as frames, laser.lit():
        motion, timeout = mover.begin(line)
        over: list[float] = []
        deadline = clock.now() + timeout

        def ended() -> float | None:
            laser.renew()
            if motion.done or clock.now() > deadline:
                motion.wait(0.0)  # raises what ended it early, and the deadline
                over.append(clock.now())
            return over[0] if over else None

        try:
            collector.take(frames, ended)
        except BaseException:
            with suppress(CellError):
                arm.stop()
            raise
    return states


def _on_the_line(
    track: FlangeTrack, times: Vector, plan: ScanPlan, errors: SweepErrors
) -> tuple[NDArray[np.intp], Vector, Vector, int]:
    """The n lines taken on the planned stretch while the arm moved evenly: which, base_from_flange (n, 4, 4), the way
    done (n,), m; and how many were left out. Raises `DeviceFault` where those are too many."""
    along, length = _straight(plan)
    seen = np.flatnonzero(track.inside(times))
    flanges = track.at(times[seen])
    done = (flanges[:, :3, 3] - plan.base_from_flange.translation) @ along
    within = (done >= 0) & (done <= length)
    even = track.even(times[seen])
    uneven = int(np.count_nonzero(within & ~even))
    if uneven > errors.lost * np.count_nonzero(within):
        raise DeviceFault(
            track.name, "arm.uneven_sweep",
            f"where the arm was is not known at {uneven} of {np.count_nonzero(within)} profiles, allowed are "
            f"{100 * errors.lost:.0f} %: it did not move evenly between the states that came from it", recoverable=True,
            hint="Look at the arm's link and at what else this machine is busy with.",
        )  # fmt: skip
    within &= even
    return seen[within], flanges[within], done[within], uneven


def _swath_of(collector: SweepCollector, lines: NDArray[np.intp], camera: str, errors: SweepErrors) -> partial[Swath]:
    """The swath of these lines, as far as the collector knows it. Raises `DeviceFault` where too many frames were lost
    or the camera's clock stepped."""
    middle, profile = collector.require_frames(camera, lines, errors.lost)
    collector.require_one_clock(camera, errors)
    ids = np.array(collector.frame_ids)
    return partial(
        Swath, builder=collector.builder, lines=lines, frame_ids=ids[lines],
        points=sum(collector.counts[k] for k in lines), middle=middle, middle_profile=profile, seen=ids,
    )  # fmt: skip


def _covariance(errors: SweepErrors, along: Vector, variance: float) -> Vector:
    """Of base_from_flange (6, 6), common to all lines; `variance`, m², is that of the whole sweep along its way."""
    shared = np.zeros((6, 6))
    shared[:3, :3] = np.outer(along, along) * variance
    return errors.repeatability + shared


MAX_FLANGE_MOTION = 1e-4
MAX_RESIDUAL = 5.0
"""Median distance of the rail's readings from an even motion that a sweep may have, in σ of a rail position."""


def rail_sweep(plan: ScanPlan, mover: Mover, devices: Devices, errors: SweepErrors, collector: SweepCollector) -> Swath:
    """Sweep the scan head over the placement area and pair every profile with the rail's position.

    Raises `DeviceFault` when more than `errors.lost` of the frames were lost, none came from the constant-velocity
    part, the flange moved by more than 0.1 mm meanwhile, the replies of rail or camera came so late that the sweep may
    lie off by more than `errors.shift`, or the rail did not run evenly.
    """
    scan, rail, arm = collector.scan, devices.rail, devices.arm
    start = rail.sweep_start(plan.rail_start, plan.rail_stop, scan.speed)
    with beside_arm(mover, rail, lambda: rail.move_to(start)):
        mover.to(plan.base_from_flange, "the scan pose")
    devices.scan_camera.configure(scan.exposure, scan.frame_rate)
    collector.notes = meet_light(devices)
    base_from_flange = from_ur(arm.state().flange)
    sweep = _sweep_lit(plan, devices, collector)
    begin, end = sweep.window
    # Stamps that come late are put back to when the exposures were.
    late = 0.0 if errors.timing is None else errors.timing.late
    times = np.array(collector.times) - late
    lines = np.flatnonzero((times >= begin) & (times <= end))
    swath = _swath_of(collector, lines, devices.scan_camera.name, errors)
    moved = np.linalg.norm(from_ur(arm.state().flange).translation - base_from_flange.translation)
    if not moved <= MAX_FLANGE_MOTION:
        raise DeviceFault(
            arm.name, "arm.moved_in_sweep",
            f"the flange moved by {1e3 * moved:.2f} mm during the sweep, allowed {1e3 * MAX_FLANGE_MOTION:.1f} mm",
            recoverable=True, hint="See what pushed the arm; the sweep is of no use.",
        )  # fmt: skip
    _require_even(rail.name, sweep, errors)
    times_known = [TimeBound(rail.name, "rail", sweep.time_bound), TimeBound.of(devices.scan_camera)]
    shift, variance = shift_by_times(times_known, scan.speed, errors.by_rail)
    devices.gate.seen("rail", RailPath(sweep.samples))
    residual = _residual(sweep, devices, errors)
    along = collector.builder.sweep_direction(base_from_flange)
    spread = errors.rail * along
    return swath(
        times=times[lines], flanges=np.tile(base_from_flange.homogeneous, (len(lines), 1, 1)),
        rail=np.array([sweep.position_at(time) for time in times[lines]]), line_spread=np.tile(spread, (len(lines), 1)),
        covariance=_covariance(errors, along, variance), lost=collector.lost, residual=residual, shift=shift,
    )  # fmt: skip


def _sweep_lit(plan: ScanPlan, devices: Devices, collector: SweepCollector) -> Sweep:
    """Have the rail sweep under the lit laser while frames are taken."""
    laser = devices.laser
    # The laser within the stream: it goes off first, however long the camera takes to end its frames.
    with devices.interlocks.purpose("sweep"), devices.scan_camera.stream() as frames, laser.lit():
        sweep = devices.rail.sweep(plan.rail_start, plan.rail_stop, collector.scan.speed)

        def ended() -> float | None:
            laser.renew()
            if not sweep.done:
                return None
            sweep.wait(1.0)
            return sweep.window[1]

        collector.take(frames, ended)
    return sweep


def _require_even(rail: str, sweep: Sweep, errors: SweepErrors) -> None:
    """Raise `DeviceFault` where the rail's readings lie too far off an even motion."""
    allowed = MAX_RESIDUAL * errors.rail * max(1.0, errors.rate)
    if not sweep.unevenness <= allowed:
        raise DeviceFault(
            rail, "rail.uneven_sweep",
            f"the rail's readings lie {1e3 * sweep.unevenness:.3f} mm (median) off an even motion, more than their "
            f"round trips explain; allowed {1e3 * allowed:.3f} mm", recoverable=True,
            hint="See whether the carriage jams and what else commands this module.",
        )  # fmt: skip


def _residual(sweep: Sweep, devices: Devices, errors: SweepErrors) -> float:
    """Median distance, m, of the rail's readings in the window from where the sweep has them; 0 without any. A
    simulated world that follows a real rail may have seen it no farther off."""
    begin, end = sweep.window
    samples = sweep.samples
    moving = samples[(samples[:, 0] >= begin) & (samples[:, 0] <= end)]
    deviations = [abs(position - sweep.position_at(time)) for time, position in moving]
    if not deviations:
        return 0.0
    if devices.following is not None:
        devices.following.require_paired(float(np.percentile(deviations, 95)), MOST_SCATTER * errors.rail)
    return float(np.median(deviations))
