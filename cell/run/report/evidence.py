"""What a run was judged by: its measured figures beside their limits, and what it looked at when it was refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from cell.config.job import AreaSection, Job
from cell.measure.inversion import NominalSurface, PlacePose, fit_figures
from cell.measure.inversion.effects.during_sweep import find_rocking
from cell.measure.inversion.texture import Texture, heights_over, measure_texture
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.frame_store import FrameStore
from cell.procedures.placed_part import PlacedPart
from cell.procedures.steps import verify
from cell.procedures.steps.place import PlaceResult
from cell.procedures.steps.reconstruct import Reconstruction
from cell.procedures.steps.set_down import SetDown
from cell.procedures.steps.verify_nest import where_seen
from cell.procedures.sweep.stored_sweep import SweepRecord
from drivers.errors import Measured, MeasuredRow, RefusedError
from drivers.interfaces import Vector
from statemachine.runner import RunResult
from statemachine.step import Outcome

CLOUD = "cloud.ply"
JUDGED = (Outcome.REFUSED, Outcome.MISPLACED)
"""The ends that rest on figures."""


@dataclass(frozen=True, eq=False)
class RefusalEvidence:
    """`numbers` that a refusal rests on, first those that decided; `seen` what was looked at, by name (`frame` and
    `view` of the board, `cloud`, `pose` of the surface that was judged and not believed)."""

    numbers: tuple[Measured, ...]
    seen: Mapping[str, object]

    @classmethod
    def of(cls, result: RunResult) -> RefusalEvidence:
        """What the error behind the end of a run shows; nothing for other ends."""
        error = result.error
        if result.outcome in JUDGED and isinstance(error, RefusedError):
            return cls(tuple(sorted(error.numbers, key=lambda number: number.kept)), error.seen)
        return cls((), {})


def ended_in(result: RunResult) -> str | None:
    """The step in which a run ended that did not place; None when it ended between steps."""
    return next((step.name for step in reversed(result.steps) if step.state == "failed"), None)


def refusal(result: RunResult, folder: Path, frames: FrameStore) -> dict[str, object] | None:
    """The report's part of this name: why, in which step, on which numbers, and the files that show it."""
    if result.outcome not in JUDGED:
        return None
    return {
        "step": ended_in(result), "reason": result.reason,
        "numbers": [number.as_dict() for number in RefusalEvidence.of(result).numbers],
        "frames": last_frames(result, frames), "cloud": CLOUD if (folder / CLOUD).exists() else None,
        **({} if (placed := seen_placed(result)) is None else {"placed": placed.summary()}),
    }  # fmt: skip


def seen_placed(result: RunResult) -> PlacedPart | None:
    """Where the placed part was seen, in its place or not; None where nobody looked, or it was not found."""
    seen = result.results.get(verify.STEP.name) or RefusalEvidence.of(result).seen.get("placed")
    return seen if isinstance(seen, PlacedPart) else None


def seen_words(result: RunResult) -> str:
    """Why a run of a job that names its part's mesh has placed it."""
    if (seen := seen_placed(result)) is not None:
        return f"in place{', as far as it shows' if seen.unseen else ''}: {seen.words}"
    return f"{result.reason}; nobody looked at the placed part (place.verify)"


def last_frames(result: RunResult, frames: FrameStore) -> list[str]:
    """Files of the frames that the step looked at in which a run ended, the newest last; none when it placed."""
    return [] if result.outcome is Outcome.PLACED else [f"frames/{name}" for name in frames.recent]


def textures_of(result: RunResult, nominal: NominalSurface, areas: Sequence[AreaSection]) -> dict[str, Texture]:
    """The waviness of the scanned surface, by the name "", and of each of its `areas`, by its own. Also at a place that
    was judged and not believed; empty without a place."""
    sweep, made, found = (result.results.get(name) for name in ("laser_sweep", "reconstruct", "invert_pose"))
    place = found.base_from_surface if isinstance(found, PlacePose) else RefusalEvidence.of(result).seen.get("pose")
    if not (isinstance(sweep, SweepRecord) and isinstance(made, Reconstruction) and isinstance(place, pin.SE3)):
        return {}
    rocking = find_rocking(made.cloud, nominal, place, sweep.times)
    shaken = 0.0 if rocking is None else rocking.height / float(np.sqrt(2.0))

    def told(within: Vector | None) -> Texture:
        motions = made.by_calibration, made.by_poses
        return measure_texture(heights_over(made.cloud, nominal, place, motions, shaken, within=within))

    return {"": told(None), **{area.name: told(area.corners) for area in areas}}


def measured(
    result: RunResult, job: Job, truth: Mapping[str, Any] | None, bound: Mapping[str, Any] | None
) -> list[MeasuredRow]:
    """Every figure that the run was or can be judged by, beside its limit: what decided a refusal comes first."""
    fix, pose, placed = (result.results.get(name) for name in ("board_photo", "invert_pose", "place"))
    if isinstance(down := result.results.get("set_down"), SetDown):
        placed = down.put
    found = list(RefusalEvidence.of(result).numbers)
    tolerance = 1e3 * job.place.tolerance
    if truth is not None:
        found.append(Measured("place error, largest of 45 points", truth["error_mm"]["d"]["max"], "mm", most=tolerance))
    if (seen := seen_placed(result)) is not None:
        found += seen.measured(where_seen(job).place)
    elif bound is not None and not job.unloads:
        found.append(Measured("place error, stated 95 % bound", bound["d"], "mm", most=tolerance))
    if isinstance(placed, PlaceResult):
        travel = 1e3 * job.place.contact_travel
        found.append(Measured("contact depth", 1e3 * placed.depth_error, "mm", most=travel))
        if placed.touch is not None:
            found.append(placed.touch.measured)
        if placed.mating is not None:
            found.append(placed.mating.measured(job.place.tolerance))
    if isinstance(pose, PlacePose):
        found += fit_figures(pose.coverage, pose.share, pose.rms, pose.chi2_per_dof)
    if isinstance(fix, BoardFix):
        most = job.photo.max_residual
        found.append(Measured("board's dots off their places, RMS", fix.residual_px, "px", most=most))
    known: dict[str, Measured] = {}
    for number in found:
        known.setdefault(number.name, number)
    return [number.as_dict() for number in known.values()]
