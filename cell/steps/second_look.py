"""Does the surface still lie where it was swept? A few lines of it are swept once more before the part is put down.

The board may stand firm while the surface slides beside it, pushed by a sleeve or a hose; a run that is resumed rests
on a sweep of an hour ago. Nothing that the arm feels tells a shift to the side.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from cell.calibration.collect.witness import configure_fast
from cell.inversion import PlacePose
from cell.inversion.moved import LEAST_MATCHED, SurfaceMotion, surface_motion
from cell.job import ScanSection
from cell.reconstruction import flange_motions
from cell.steps.laser_sweep import swept
from cell.steps.photograph import BoardFix
from cell.steps.reconstruct import Reconstruction, build_cloud
from cell.steps.sweep_record import SweepRecord
from cell.steps.workplace import Workplace
from drivers.errors import Measured, RefusedError
from statemachine.runner import StepContext

LINES = 32
"""Enough for a vehicle that rocks to average out."""


def require_in_place(
    here: Workplace, fix: BoardFix, sweep: SweepRecord, scan: Reconstruction, pose: PlacePose, context: StepContext
) -> SurfaceMotion:
    """Sweep one strip of the surface again, in few lines, and compare: what little it seems to have moved.

    Raises `RefusedError` when it has moved by more than lines and arm leave open, and what a sweep raises.
    """
    # The arm is not moved from where it stands already.
    stood = sweep.rest is not None and sweep.rest is here.devices.interlocks.situation.last and len(sweep.swaths) == 1
    head = here.calibration.scan
    if sweep.pointing is not None:
        head = head.pointed(sweep.pointing, here.config.laser.exit_point)
    few = sparse(here.job.scan)
    # A camera of a few frame rates takes all the lines.
    rate = configure_fast(here.devices, few.exposure, (few.frame_rate, here.job.scan.frame_rate))
    again = swept(
        here, fix, head, few.model_copy(update={"frame_rate": rate}),
        lambda frame: here.frames.keep("second-look", frame), context.check,
        lambda share, text: context.progress(0.1 * share, f"whether the surface lies where it did: {text}"),
    )  # fmt: skip
    cloud, surface = build_cloud(again), here.job.surface
    before = [np.zeros((6, 6))] if stood else [swath.covariance for swath in sweep.swaths]
    now = [here.settling] if stood else [swath.covariance for swath in again.swaths]
    found = surface_motion(
        scan.cloud,
        cloud,
        here.nominal,
        pose.base_from_surface,
        np.diag([surface.prior_sigma**2] * 3 + [surface.prior_sigma_angle**2] * 3),
        (partial(flange_motions, scan.cloud, covariances=before), partial(flange_motions, cloud, covariances=now)),
    )
    require_unmoved(found)
    return found


def sparse(scan: ScanSection) -> ScanSection:
    """One strip of a scan with the same speed and about `LINES` lines."""
    rate = min(scan.frame_rate, max(1.0, LINES * scan.speed / scan.length))
    return scan.model_copy(update={"frame_rate": rate, "swath": scan.swath[:1]})


def require_unmoved(found: SurfaceMotion) -> None:
    """Raise `RefusedError` for a surface that lies elsewhere."""
    if not found.moved:
        return
    next_step = "See what pushed it, then run the job again from its sweep"
    if found.matched < LEAST_MATCHED:
        raise RefusedError(
            f"the surface does not lie any more where it was swept: of its second sweep {100 * found.matched:.0f} % as "
            f"many points lie on it as of the first. {next_step}",
            Measured("second sweep on the surface", 100 * found.matched, "%", least=100 * LEAST_MATCHED),
        )
    shift, turn = 1e3 * float(np.linalg.norm(found.motion[:3])), float(np.degrees(np.linalg.norm(found.motion[3:])))
    raise RefusedError(
        f"the surface has moved by {shift:.2f} mm and {turn:.3f} deg since it was swept. {next_step}",
        Measured("surface moved, against what chance brings", found.times, "times", most=1.0),
    )
