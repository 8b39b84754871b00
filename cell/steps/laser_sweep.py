"""The laser sweep: to the scan pose, settle, laser on, constant-velocity sweep, laser off; as often as the job asks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pinocchio as pin

from cell.devices.assembly import Devices
from cell.job import ScanSection
from cell.reconstruction import ScanGeometry
from cell.steps.arm_sweep import arm_sweep
from cell.steps.camera_poses import ScanPlan
from cell.steps.moves import Mover
from cell.steps.rail_sweep import rail_sweep
from cell.steps.swath import Collector, Swath, SweepErrors, rehearse
from cell.vision import StripeProfile
from drivers.interfaces import Frame


@dataclass(frozen=True, eq=False)
class SweepRecord:
    """What the sweeps brought, in their order; at least one."""

    swaths: tuple[Swath, ...]

    @property
    def base_from_flange(self) -> pin.SE3:
        """Where the flange was half-way through the first sweep."""
        return self.swaths[0].base_from_flange

    @property
    def middle(self) -> Frame:
        """The frame from the middle of the first sweep."""
        return self.swaths[0].middle

    @property
    def middle_profile(self) -> StripeProfile:
        """The stripe in `middle`."""
        return self.swaths[0].middle_profile

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {
            "sweeps": len(self.swaths),
            "profiles": sum(len(swath.lines) for swath in self.swaths),
            "lost_frames": sum(swath.lost for swath in self.swaths),
            "points": sum(swath.points for swath in self.swaths),
            "residual_um": [round(1e6 * swath.residual, 2) for swath in self.swaths],
            "time_shift_um": [round(1e6 * swath.shift, 2) for swath in self.swaths],
        }


def laser_sweep(
    plans: Sequence[ScanPlan],
    scan: ScanSection,
    geometry: ScanGeometry,
    errors: SweepErrors,
    mover: Mover,
    devices: Devices,
    keep_frame: Callable[[Frame], None],
    check: Callable[[], None],
    progress: Callable[[float, str], None],
) -> SweepRecord:
    """Sweep the scan head over every planned strip, by the rail or by the arm as `scan.mode` says.

    `check` raises when the run is to end. Raises what `rail_sweep` and `arm_sweep` raise.
    """
    sweep = arm_sweep if scan.mode == "arm" else rail_sweep
    progress(0.01, "preparing")
    rehearse(geometry)
    swaths = []
    for k, plan in enumerate(plans):
        check()
        name = f"sweep {k + 1} of {len(plans)}"

        def tell(fraction: float, text: str, k: int = k, name: str = name) -> None:
            progress((k + fraction) / len(plans), f"{name}: {text}" if len(plans) > 1 else text)

        tell(0.02, "arm to the scan pose")
        swaths.append(sweep(plan, mover, devices, errors, Collector(geometry, scan, keep_frame, tell)))
    return SweepRecord(tuple(swaths))
