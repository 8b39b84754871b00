"""The whole measuring chain from recorded frames with flange poses: camera, hand-eye, light plane and its flatness.

The camera may ride on the flange or stand before it, and nobody need say which.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from cell.calibration.observations import ScanObservation
from cell.calibration.recorded.folder import RecordedFrame
from cell.calibration.recorded.result import (
    camera_dict,
    closed_form_dict,
    finite_mm,
    flatness_dict,
    hand_eye_dict,
    plane_dict,
    seen_depths,
)
from cell.calibration.solve.blocks import PLANE
from cell.calibration.solve.flatness import Flatness, choose_arm, flatness, leave_one_out
from cell.calibration.solve.joint import Joint, Staged, solve_joint, solve_staged, start_state
from cell.geometry.camera import PARAMETER_NAMES
from cell.vision.board.board import board_pose
from drivers.errors import RefusedError

TANGENTIAL_VIEWS = 12


@dataclass(frozen=True, eq=False)
class Chain:
    """What frames with poses give."""

    setup: str
    staged: Staged
    joint: Joint
    tried: dict[str, float]
    flat_staged: Flatness | None
    flat: Flatness | None
    left_out: Flatness | None


def solve_chain(frames: Sequence[RecordedFrame], known: str | None = None) -> Chain:
    """Staged and joint solution with the camera as `known`, on the flange or before it, or whichever fits."""
    best: tuple[float, str, list[ScanObservation], Staged] | None = None
    for setup in ("eye_in_hand", "eye_to_hand") if known is None else (known,):
        observations = [_observation(f, invert=setup == "eye_to_hand") for f in frames]
        lit = sum(o.profile is not None for o in observations) >= 2
        staged = None
        for stripe in (True, False) if lit else (False,):
            try:
                staged = solve_staged(observations, stripe=stripe)
                break
            except RefusedError:
                if not stripe:
                    raise
        assert staged is not None
        if best is None or staged.hand_eye.scatter_m < 0.5 * best[0]:
            best = staged.hand_eye.scatter_m, setup, observations, staged
    assert best is not None
    _, setup, observations, staged = best
    tangential = len(observations) >= TANGENTIAL_VIEWS
    priors, tried = choose_arm(observations, staged, tangential)
    joint = solve_joint(observations, staged, priors, tangential)
    state = joint.adjusted.state
    return Chain(
        setup,
        staged,
        joint,
        tried,
        flatness(start_state(staged), observations, staged),
        flatness(state, observations, staged),
        leave_one_out(observations, staged, state, joint.adjusted.priors, tangential),
    )


def _observation(frame: RecordedFrame, invert: bool) -> ScanObservation:
    assert frame.base_from_flange is not None
    pose = frame.base_from_flange.inverse() if invert else frame.base_from_flange
    return ScanObservation(frame.view, frame.profile, pose, 0.0, frame.name)


def report_chain(chain: Chain, frames: Sequence[RecordedFrame], result: dict[str, Any]) -> None:
    """Put camera, hand-eye, light plane, noise and flatness into the result, lengths in mm."""
    adjusted, state = chain.joint.adjusted, chain.joint.adjusted.state
    boards = [
        f * state.flange_from_camera * board_pose(frame.view, state.camera).camera_from_board
        for f, frame in zip((v.base_from_flange for v in chain.joint.views), frames, strict=True)
        if frame.view is not None
    ]
    apart = [b.translation - state.base_from_board.translation for b in boards]
    turns = [float(np.linalg.norm(pin.log3(b.rotation @ state.base_from_board.rotation.T))) for b in boards]
    sigma = np.sqrt(np.maximum(np.diag(adjusted.covariance), 0.0))
    result["intrinsics"] = {
        **camera_dict(state.camera),
        "rms_px": math.sqrt(2) * adjusted.dots_rms_px,
        "held_out_at_reported_poses_rms_px": math.sqrt(2) * chain.joint.held_out_px,
        "sigma_px": dict(zip(PARAMETER_NAMES[:4], sigma[:4].tolist(), strict=True)),
        "method": "joint adjustment",
    }
    result["hand_eye"] = {
        "method": "joint adjustment",
        **hand_eye_dict(chain.setup, state.flange_from_camera),
        "scatter_mm": 1e3 * float(np.sqrt(np.mean(np.sum(np.square(apart), axis=1)))),
        "scatter_deg": math.degrees(float(np.sqrt(np.mean(np.square(turns))))),
        "sigma_mm": (1e3 * sigma[15:18]).tolist(),
        "sigma_deg": np.degrees(sigma[18:21]).tolist(),
        "frames": len(frames),
        "closed_form": closed_form_dict(chain.setup, chain.staged.hand_eye),
    }
    result["noise"] = {
        "arm_translation_mm": 1e3 * adjusted.priors.arm_translation,
        "arm_rotation_deg": math.degrees(adjusted.priors.arm_rotation),
        "arm_chosen_by": "least error of left-out frames; tried mm: figure",
        "arm_tried": chain.tried,
        "chi2_per_dof": adjusted.chi2_per_dof,
    }
    if state.plane is None or chain.staged.plane is None:
        result["notes"].append("no light plane: no frame shows a laser stripe on the board in a usable way")
        return
    result["light_plane"] = {
        **plane_dict(state.plane),
        "rms_mm": 1e3 * adjusted.stripe_rms_m,
        "depth_range_mm": seen_depths(state.plane, state.camera, [v.stripe for v in chain.joint.views]),
        "sigma_distance_mm": 1e3 * float(sigma[PLANE][2]),
        "method": "joint adjustment",
        "staged": {
            **plane_dict(chain.staged.plane.plane),
            "rms_mm": 1e3 * chain.staged.plane.rms,
            "cross_ratio_check_mm": None if chain.staged.paper is None else finite_mm(chain.staged.paper.cross_ratio_m),
        },
    }
    names = [f.name for f in frames]
    rows = chain.staged.plane.rows
    result["stripe_points"] = {n: len(r) for n, r in zip(names, rows, strict=True)}
    if chain.flat is not None:
        result["flatness"] = {
            **flatness_dict(chain.flat, names),
            "frame": "base" if chain.setup == "eye_in_hand" else "flange",
            "leave_one_out": None if chain.left_out is None else flatness_dict(chain.left_out, names),
            "staged": None if chain.flat_staged is None else flatness_dict(chain.flat_staged, names),
        }
