"""A sweep by the rail: the arm stands still, the carriage runs at constant velocity under the lit laser."""

from __future__ import annotations

import numpy as np

from cell.devices.devices import Devices
from cell.devices.simulated.following import MOST_SCATTER
from cell.measure.geometry.poses import from_ur
from cell.procedures.arm.camera_poses import ScanPlan
from cell.procedures.arm.moves import Mover
from cell.procedures.observed import RailPath
from cell.procedures.sweep.swath import Swath, SweepCollector, SweepErrors, TimeBound, shift_by_times
from drivers.errors import DeviceFault

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
    mover.to(plan.base_from_flange, "the scan pose")
    rail.move_to(rail.sweep_start(plan.rail_start, plan.rail_stop, scan.speed)).wait(30.0)
    devices.scan_camera.configure(scan.exposure, scan.frame_rate)
    base_from_flange = from_ur(arm.state().flange)
    laser = devices.laser
    # The laser within the stream: it goes off first, however long the camera takes to end its frames.
    with devices.interlocks.purpose("sweep"), devices.scan_camera.stream() as frames, laser.lit():
        sweep = rail.sweep(plan.rail_start, plan.rail_stop, scan.speed)

        def ended() -> float | None:
            laser.renew()
            if not sweep.done:
                return None
            sweep.wait(1.0)
            return sweep.window[1]

        collector.take(frames, ended)
    begin, end = sweep.window
    # Stamps that come late are put back to when the exposures were.
    late = 0.0 if errors.timing is None else errors.timing.late
    times = np.array(collector.times) - late
    lines = np.flatnonzero((times >= begin) & (times <= end))
    middle = collector.require_frames(devices.scan_camera.name, lines, errors.lost)
    collector.require_one_clock(devices.scan_camera.name, errors)
    moved = np.linalg.norm(from_ur(arm.state().flange).translation - base_from_flange.translation)
    if not moved <= MAX_FLANGE_MOTION:
        raise DeviceFault(
            arm.name,
            "arm.moved_in_sweep",
            f"the flange moved by {1e3 * moved:.2f} mm during the sweep, allowed {1e3 * MAX_FLANGE_MOTION:.1f} mm",
            recoverable=True,
            hint="See what pushed the arm; the sweep is of no use.",
        )
    allowed = MAX_RESIDUAL * errors.rail * max(1.0, errors.rate)
    if not sweep.unevenness <= allowed:
        raise DeviceFault(
            rail.name,
            "rail.uneven_sweep",
            f"the rail's readings lie {1e3 * sweep.unevenness:.3f} mm (median) off an even motion, more than their "
            f"round trips explain; allowed {1e3 * allowed:.3f} mm",
            recoverable=True,
            hint="See whether the carriage jams and what else commands this module.",
        )
    times_known = [TimeBound(rail.name, "rail", sweep.time_bound), TimeBound.of(devices.scan_camera)]
    shift, variance = shift_by_times(times_known, scan.speed, errors.by_rail)
    samples = sweep.samples
    devices.gate.seen("rail", RailPath(samples))
    moving = samples[(samples[:, 0] >= begin) & (samples[:, 0] <= end)]
    deviations = [abs(position - sweep.position_at(time)) for time, position in moving]
    residual = float(np.median(deviations)) if deviations else 0.0
    if devices.following is not None and deviations:
        devices.following.require_paired(float(np.percentile(deviations, 95)), MOST_SCATTER * errors.rail)
    along = collector.builder.sweep_direction(base_from_flange)
    spread = errors.rail * along
    shared = np.zeros((6, 6))
    shared[:3, :3] = np.outer(along, along) * variance
    return Swath(
        builder=collector.builder,
        lines=lines,
        frame_ids=np.array(collector.frame_ids)[lines],
        times=times[lines],
        flanges=np.tile(base_from_flange.homogeneous, (len(lines), 1, 1)),
        rail=np.array([sweep.position_at(time) for time in times[lines]]),
        line_spread=np.tile(spread, (len(lines), 1)),
        covariance=errors.repeatability + shared,
        lost=collector.lost,
        residual=residual,
        shift=shift,
        points=sum(collector.counts[k] for k in lines),
        middle=middle[0],
        middle_profile=middle[1],
        seen=np.array(collector.frame_ids),
    )
