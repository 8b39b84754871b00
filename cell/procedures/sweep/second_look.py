"""Does the surface still lie where it was swept? A few lines on the way back tell, before the part is put down.

The surface may slide while the board stands firm. Nothing that the arm feels tells a shift to the side. A placed part
is looked at again on the rail's way back: it may still slide, sink or turn.
"""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import pinocchio as pin

from cell.measure.calibration import ScanCalibration
from cell.measure.inversion import PlacePose
from cell.measure.inversion.effects import between_sweeps
from cell.measure.inversion.observability import Tolerance
from cell.measure.reconstruction.build import flange_motions
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.steps.board_photo import require_board_unmoved
from cell.procedures.steps.laser_sweep import head_at, in_few_lines, pace, times_known
from cell.procedures.steps.reconstruct import Reconstruction, build_cloud
from cell.procedures.steps.workplace import Workplace
from cell.procedures.sweep.stored_sweep import SweepRecord
from cell.procedures.sweep.swath import Swath
from cell.procedures.sweep.sweeping import LATENCY_S, check_lost_steps
from drivers.errors import Measured, RefusedError
from drivers.interfaces import Vector
from statemachine.runner import StepContext

LEAST_POINTS = 500
PLAY_M = 20e-6
"""By how much a carriage stands otherwise when it comes from the other side, where that was not measured."""
FRESH_S = 5.0
"""So old, s of the cell, a look may be before the part goes down: computing takes less."""
NEXT_STEP = "See what pushed it, then run the job again from its sweep"


@dataclass(frozen=True, eq=False)
class SecondLook:
    """By how much the surface seemed to have `moved`, and in words what is `hidden`: motions that could be larger than
    the place's tolerance unseen. `creep` is how it moves on, where that shows. `counted` says whether the rail was
    asked since whether it has lost steps."""

    moved: between_sweeps.SurfaceMotion
    hidden: tuple[str, ...]
    creep: between_sweeps.Creep | None = None
    counted: bool = False

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not as usual, for people."""
        creeps = () if self.creep is None else (self.creep.words,)
        if not self.hidden:
            return creeps
        return (
            *creeps,
            "a motion of the surface alone since it was swept could be larger than place.tolerance unseen: "
            f"{', '.join(self.hidden)}. Let nobody touch it meanwhile",
        )


def require_in_place(
    workplace: Workplace, fix: BoardFix, sweep: SweepRecord, scan: Reconstruction, pose: PlacePose, context: StepContext
) -> SecondLook:
    """Compare the sweep with its way back, or sweep the last strip again where that is too long ago; photograph the
    board if the lines leave much open.

    Whoever goes on looks whether the rail has lost steps, unless that was `counted`.
    Raises `RefusedError` when either has moved by more than chance brings, and what a sweep and a photograph raise.
    """
    place = workplace.job.place
    back = sweep.back if on_the_way_back(workplace, sweep, context) else None
    found, creep = _swept_again(workplace, fix, sweep, back, scan=scan, pose=pose, context=context)
    counted = back is not None or workplace.job.scan.mode == "arm"
    if found.moved and not counted:
        # Steps that the rail has lost look like a surface that moved.
        check_lost_steps(workplace.devices, lambda _, text: context.progress(0.04, text))
    require_surface_unmoved(found)
    tolerance = Tolerance(place.tolerance, place.tolerance_angle)
    hidden = tuple(found.hidden(pose.base_from_surface, tolerance, workplace.nominal.radius))
    if hidden or pose.verdict.unseen:
        require_board_unmoved(workplace, fix, "before the sweep", lambda _, text: context.progress(0.04, text))
    return SecondLook(found, hidden, creep, counted)


def _swept_again(
    workplace: Workplace, fix: BoardFix, sweep: SweepRecord, back: SweepRecord | None, *, scan: Reconstruction,
    pose: PlacePose, context: StepContext,
) -> tuple[between_sweeps.SurfaceMotion, between_sweeps.Creep | None]:  # fmt: skip
    # The arm is not moved from where it stands already.
    stood = sweep.rest is not None and sweep.rest is workplace.devices.interlocks.situation.last
    there = sweep.swaths[-1]
    again = back if back is not None else in_few_lines(
        workplace, workplace.base_from_surface(fix), head_at(workplace, sweep), there, keep="second-look",
        check=context.check, progress=lambda share, text: context.progress(0.04 * share,
        f"whether the surface lies where it did: {text}"),
    )  # fmt: skip
    once_more = again.swaths[0]
    if back is None:
        otherwise = _shifted(there, _late(workplace) * (pace(once_more) - pace(there)))
    else:
        otherwise = _other_way(workplace, there, once_more)
    # What lens and light plane are off by cancels in the same strip only.
    before, now = scan.cloud.of_sweep(len(sweep.swaths) - 1), require_points(build_cloud(again))
    spread, spread_now = there.covariance, once_more.covariance
    if stood:
        spread, spread_now = by_times(there), workplace.settling + by_times(once_more) + otherwise
    elif back is not None:
        spread_now = spread_now + otherwise
    by_poses = [
        partial(flange_motions, cloud, covariances=[each]) for cloud, each in ((before, spread), (now, spread_now))
    ]
    moved = between_sweeps.surface_motion(
        before, now, workplace.nominal, pose.base_from_surface, (by_poses[0], by_poses[1])
    )
    if not stood:
        return moved, None
    unsure = by_times(there) + by_times(once_more) + otherwise
    middles = float(there.times.mean()), float(again.times.mean())
    return moved, between_sweeps.Creep.of(moved, unsure, pose.base_from_surface.translation, *middles)


def on_the_way_back(workplace: Workplace, sweep: SweepRecord, context: StepContext) -> bool:
    """Whether the look on the sweep's way back still tells where the surface lies: nobody held the run since, and it is
    `FRESH_S` ago at most."""
    if sweep.back is None or context.held_s != sweep.held_s:
        return False
    return 0.0 <= workplace.devices.clock.now() - float(sweep.back.times[-1]) <= FRESH_S


def by_times(swath: Swath) -> Vector:
    """Covariance (6, 6) of base_from_flange by what replies leave open of this sweep's times. How late stamps come all
    the time is the same in two sweeps by one device."""
    return _shifted(swath, swath.shift / math.sqrt(3.0))


def _shifted(swath: Swath, sigma: float) -> Vector:
    """Covariance (6, 6) of base_from_flange for a shift along the sweep, one standard deviation in m."""
    along = sigma * swath.builder.sweep_direction(swath.base_from_flange)
    shared = np.zeros((6, 6))
    shared[:3, :3] = np.outer(along, along)
    return shared


def moved_meanwhile(
    workplace: Workplace, head: ScanCalibration, over: pin.SE3, swept: tuple[Cloud, SweepRecord], *,
    part: between_sweeps.PartOnGround, context: StepContext,
) -> float | None:  # fmt: skip
    """Sweep the last strip the other way, in few lines: how far, m, the part has moved on since, as `part.moved` has
    it. Raises what a sweep raises."""
    cloud, sweep = swept
    before = sweep.swaths[-1]
    back = in_few_lines(
        workplace, over, head, before, keep="way-back", check=context.check, back=True,
        progress=lambda share, text: context.progress(0.85, f"whether the part lies still: {text}"),
    )  # fmt: skip
    now = back.swaths[0]
    unsure = workplace.settling + by_times(before) + by_times(now) + _other_way(workplace, before, now)
    return part.moved(cloud.of_sweep(len(sweep.swaths) - 1), build_cloud(back), unsure)


def _other_way(workplace: Workplace, there: Swath, back: Swath) -> Vector:
    """Covariance (6, 6) of base_from_flange by which sweep and way back differ: late stamps, play, the arm's rest."""
    late = _late(workplace) * (pace(there) + pace(back))
    if workplace.job.scan.mode == "arm":
        return _shifted(there, late) + 2.0 * workplace.repeatability
    timing = times_known(workplace.calibration.scan, workplace.config)[0]
    return _shifted(there, late + (PLAY_M if timing is None else abs(timing.play) + timing.play_sigma))


def _late(workplace: Workplace) -> float:
    """How late, s, one standard deviation, what is swept by comes all the time: it shifts a faster sweep farther."""
    config, timing = workplace.config, times_known(workplace.calibration.scan, workplace.config)[0]
    if workplace.job.scan.mode == "arm":
        return math.hypot(config.scan_camera.late / math.sqrt(3.0), LATENCY_S * workplace.devices.clock.rate)
    return (
        timing.sigma if timing is not None else math.hypot(config.scan_camera.late, config.rail.late) / math.sqrt(3.0)
    )


def require_points(cloud: Cloud) -> Cloud:
    """The cloud of the second sweep; raises `RefusedError` when there is next to nothing in it."""
    if cloud.size >= LEAST_POINTS:
        return cloud
    raise RefusedError(
        f"the surface was swept once more before the part is put down, and {cloud.size} points were seen in "
        f"{cloud.shape[0]} profiles (at least {LEAST_POINTS}): it is gone, or the laser does not light it any more. "
        "Look at both, then run the job again from its sweep",
        Measured("points of the second sweep", cloud.size, least=LEAST_POINTS),
    )


def require_surface_unmoved(moved: between_sweeps.SurfaceMotion) -> None:
    """Raise `RefusedError` for a surface that lies elsewhere."""
    if not moved.moved:
        return
    if moved.matched < between_sweeps.LEAST_MATCHED:
        raise RefusedError(
            f"the surface does not lie any more where it was swept: of its second sweep {100 * moved.matched:.0f} % as "
            f"many points lie on it as of the first, allowed are {100 * between_sweeps.LEAST_MATCHED:.0f} %. "
            f"{NEXT_STEP}",
            Measured("second sweep on the surface", 100 * moved.matched, "%", least=100 * between_sweeps.LEAST_MATCHED),
        )
    if moved.found is None:
        far = "by some millimetres or degrees, too far to tell how much,"
    else:
        shift, turn = np.linalg.norm(moved.found[:3]), np.linalg.norm(moved.found[3:])
        far = f"by {1e3 * shift:.2f} mm and {np.degrees(turn):.3f} deg"
    raise RefusedError(
        f"the surface has moved {far} since it was swept, {moved.times:.1f} times as far as chance brings. {NEXT_STEP}",
        Measured("surface moved, against what chance brings", moved.times, "times", most=1.0),
    )
