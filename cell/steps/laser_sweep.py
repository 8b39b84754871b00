"""The laser sweep: to the scan pose, settle, laser on, constant-velocity sweep, laser off.

A profile is computed when its frame arrives and the frame is let go, so memory does not grow with the sweep's frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.geometry.poses import from_ur
from cell.job import ScanSection
from cell.planning import ScanPlan
from cell.steps.moves import Mover
from cell.vision import StripeProfile, extract
from drivers.errors import DeviceFault
from drivers.interfaces import Arm, Camera, Frame, Laser, Rail, Vector

MAX_LOST_FRACTION = 0.05
MAX_FLANGE_MOTION = 1e-4


@dataclass(frozen=True, eq=False)
class SweepRecord:
    """What a sweep brought: a stripe profile and the rail's position in m for each frame, and the pose of the flange.

    `positions` (n,) are at the middle of each frame's exposure. `lost` frames are known from the gaps of the frame ids.
    """

    base_from_flange: pin.SE3
    profiles: list[StripeProfile]
    positions: Vector
    lost: int
    rail_residual: float
    middle: Frame
    middle_profile: StripeProfile

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "profiles": len(self.profiles),
            "lost_frames": self.lost,
            "points": int(sum(len(profile.rows) for profile in self.profiles)),
            "rail_residual_um": round(1e6 * self.rail_residual, 2),
        }


def laser_sweep(
    plan: ScanPlan,
    scan: ScanSection,
    mover: Mover,
    arm: Arm,
    rail: Rail,
    camera: Camera,
    laser: Laser,
    keep_frame: Callable[[Frame], None],
    progress: Callable[[float, str], None],
) -> SweepRecord:
    """Sweep the scan head over the placement area and pair every profile with the rail's position.

    Raises `DeviceFault` when more than 5 % of the frames were lost or none came from the constant-velocity part.
    """
    progress(0.02, "arm to the scan pose")
    mover.to(plan.base_from_flange, "the scan pose")
    rail.move_to(rail.sweep_start(plan.rail_start, plan.rail_stop, scan.speed)).wait(30.0)
    camera.configure(scan.exposure, scan.frame_rate)
    base_from_flange = from_ur(arm.state().flange)
    duration = (plan.rail_stop - plan.rail_start) / scan.speed
    expected = duration * scan.frame_rate
    stamped: list[tuple[float, StripeProfile]] = []
    middle: tuple[Frame, StripeProfile] | None = None
    with laser.lit(), camera.stream() as frames:
        sweep = rail.sweep(plan.rail_start, plan.rail_stop, scan.speed)
        # The frames' delivery may lag behind the sweep: go on until one was exposed after its end.
        ended_at = math.inf
        for frame in frames:
            if sweep.done and ended_at == math.inf:
                sweep.wait(1.0)
                ended_at = sweep.window[1]
            if frame.mid_exposure > ended_at:
                break
            keep_frame(frame)
            profile = extract(frame.image)
            stamped.append((frame.mid_exposure, profile))
            if middle is None and len(stamped) >= expected / 2:
                middle = frame, profile
            progress(min(0.99, len(stamped) / expected), f"{len(stamped)} profiles")
        lost = frames.lost
    begin, end = sweep.window
    inside = [(time, profile) for time, profile in stamped if begin <= time <= end]
    if not inside or middle is None or lost > MAX_LOST_FRACTION * expected:
        raise DeviceFault(
            camera.name,
            "camera.frames_lost",
            f"{len(inside)} frames came from the sweep and {lost} were lost, of about {expected:.0f}",
            recoverable=True,
            hint="Lower scan.frame_rate or look at the camera's link.",
        )
    moved = np.linalg.norm(from_ur(arm.state().flange).translation - base_from_flange.translation)
    if moved > MAX_FLANGE_MOTION:
        raise DeviceFault(
            arm.name,
            "arm.moved_in_sweep",
            f"the flange moved by {1e3 * moved:.2f} mm during the sweep, allowed {1e3 * MAX_FLANGE_MOTION:.1f} mm",
            recoverable=True,
            hint="See what pushed the arm; the sweep is of no use.",
        )
    samples = sweep.samples
    moving = samples[(samples[:, 0] >= begin) & (samples[:, 0] <= end)]
    residual = (
        float(np.median([abs(position - sweep.position_at(time)) for time, position in moving])) if len(moving) else 0.0
    )
    positions = np.array([sweep.position_at(time) for time, _ in inside])
    return SweepRecord(base_from_flange, [profile for _, profile in inside], positions, lost, residual, *middle)
