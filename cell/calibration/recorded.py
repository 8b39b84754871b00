"""A calibration from a folder of recorded frames, as `cell calibrate --from FOLDER --board SPEC --json` prints it.

With flange poses: camera, hand-eye, light plane and the flatness of the whole chain. Without: what can be had. A folder
with pairs of poses only gives the hand-eye.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from cell.calibration.blocks import PLANE
from cell.calibration.consistency import refuse_misplaced, refuse_odd_ones, settle_orders
from cell.calibration.flatness import Flatness, choose_arm, flatness, leave_one_out
from cell.calibration.folder import RecordedFrame, poses_without_frame, read_frames, read_pose_pairs, used
from cell.calibration.hand_eye import HandEye, refine_hand_eye, solve_hand_eye
from cell.calibration.intrinsics import Intrinsics, choose_lens
from cell.calibration.joint import Joint, Staged, solve_joint, solve_staged, start_state
from cell.calibration.observations import ScanObservation
from cell.calibration.recorded_result import (
    camera_dict,
    closed_form_dict,
    empty_result,
    finite_mm,
    flatness_dict,
    frame_dict,
    hand_eye_dict,
    intrinsics_dict,
    plane_dict,
    seen_depths,
)
from cell.calibration.starts import plane_from_board, stripe_pixels
from cell.geometry.camera import PARAMETER_NAMES, CameraModel
from cell.vision.board import board_pose
from cell.vision.board_spec import BoardSpec
from cell.vision.pictures import Reason
from drivers.errors import ConfigError, RefusedError

# A frame whose points miss their places by this many times the others' RMS, and by this many px, is not of this board.
ODD_RATIO, ODD_PX = 3.5, 0.4
LEAST_POSES = 3
TANGENTIAL_VIEWS = 12
OBLIQUE = math.radians(75.0)


@dataclass(frozen=True, eq=False)
class _Chain:
    """What frames with poses give."""

    setup: str
    staged: Staged
    joint: Joint
    tried: dict[str, float]
    flat_staged: Flatness | None
    flat: Flatness | None
    left_out: Flatness | None


def calibrate_folder(folder: Path, spec: BoardSpec | None) -> dict[str, Any]:
    """Calibrate from the pictures of a folder, or from its pairs of poses when `spec` is None or there are no pictures.

    Keys, all lengths in mm and angles in deg unless the key says otherwise, None for what the folder does not tell:

    - `board`; `frames`: `name`, `used`, `reason`, `text`, `rms_px`, `points`, `pose`, `stripe_points`;
    - `intrinsics`: `fx`, `fy`, `cx`, `cy`, `k1` … `k3`, `width`, `height`, `rms_px` (distance per point, as OpenCV has
      it), `held_out_rms_px`, `sigma_px`; `intrinsics_without_distortion`, `intrinsics_from_pictures` likewise;
    - `hand_eye`: `method`, `setup` (eye_in_hand, eye_to_hand), `translation_mm`, `rotation` (3×3),
      `rotation_vector_rad`, `euler_xyz_rad` (rotations about x, then the new y, then the new z; the
      first in 0 … π), `scatter_mm`, `scatter_deg`, of the closed form under `closed_form`;
    - `light_plane`: `normal`, `distance_mm` (normal · point = distance in the camera frame), `rms_mm`,
      `depth_range_mm`;
    - `flatness`: `rms_mm`, `p95_mm`, `points`, `extent_mm`, `per_frame`, `leave_one_out`, `staged`;
    - `noise`: what the adjustment assumed and found; `notes`: what could not be had, and why.

    Raises ConfigError when there is nothing to read.
    """
    pairs = read_pose_pairs(folder) if folder.is_dir() else []
    if spec is None:
        if not pairs:
            raise ConfigError(f"{folder}: name the board in the pictures with --board, such as chessboard:7x6:10mm")
        return _from_pairs(pairs)
    try:
        frames = read_frames(folder, spec)
    except ConfigError:
        if pairs:
            return _from_pairs(pairs)
        raise
    result = empty_result(spec)
    result["notes"] += [
        f"{name} is not used: no picture has its number" for name in poses_without_frame(folder, frames)
    ]
    _from_frames(frames, result)
    result["frames"] = [frame_dict(frame, result["frames_rms"]) for frame in frames]
    del result["frames_rms"]
    return result


def _from_frames(frames: list[RecordedFrame], result: dict[str, Any]) -> None:
    notes: list[str] = result["notes"]
    try:
        chosen, plain = _camera(frames)
    except RefusedError as error:
        notes.append(f"no intrinsics: {error}")
        return
    posed = [f for f in used(frames) if f.base_from_flange is not None]
    if len(posed) >= LEAST_POSES:
        settle_orders(posed, chosen.camera)
        before = len(posed)
        posed = refuse_misplaced(refuse_odd_ones(posed, chosen.camera), chosen.camera)
        if len(posed) < before:
            try:
                chosen, plain = _camera(frames)
            except RefusedError as error:
                notes.append(f"no intrinsics: {error}")
                return
            posed = [f for f in posed if f.reason is None]
    rest = used(frames)
    result["frames_rms"] = {f.path.name: math.sqrt(2) * r for f, r in zip(rest, chosen.view_rms, strict=True)}
    result["intrinsics"] = result["intrinsics_from_pictures"] = intrinsics_dict(chosen)
    result["intrinsics_without_distortion"] = intrinsics_dict(plain)
    if len(posed) >= LEAST_POSES:
        without_pose = len(rest) - len(posed)
        if without_pose:
            notes.append(f"{without_pose} used frames have no flange pose: they count for the intrinsics only")
        try:
            _report_chain(_chain(posed), posed, result)
            return
        except (RefusedError, np.linalg.LinAlgError) as error:
            notes.append(f"no hand-eye: {error}")
    else:
        notes.append(
            f"{len(posed)} used frames have a flange pose, at least {LEAST_POSES} are needed: no hand-eye, no flatness"
        )
    _report_plane(rest, chosen.camera, result)


def _camera(frames: list[RecordedFrame]) -> tuple[Intrinsics, Intrinsics]:
    """Camera of all used frames, those refused whose points miss by far more than the others'."""
    while True:
        kept = used(frames)
        chosen, plain = choose_lens([f.view for f in kept if f.view is not None])
        worst = int(np.argmax(chosen.view_rms))
        typical = float(np.median(chosen.view_rms))
        if chosen.view_rms[worst] > max(ODD_RATIO * typical, ODD_PX) and len(kept) > LEAST_POSES:
            kept[worst].refuse(
                Reason.RESIDUAL,
                f"the board's points miss their places by {math.sqrt(2) * chosen.view_rms[worst]:.2f} px, in the other "
                f"frames by {math.sqrt(2) * typical:.2f} px: is it another board, bent, or moved in the exposure?",
            )
            continue
        oblique = False
        for frame in kept:
            assert frame.view is not None
            angle = board_pose(frame.view, chosen.camera).obliquity
            if angle > OBLIQUE:
                oblique = True
                frame.refuse(
                    Reason.OBLIQUE, f"the board is seen {math.degrees(angle):.0f}° from square, allowed are 75°"
                )
        if not oblique:
            return chosen, plain


def _chain(frames: Sequence[RecordedFrame]) -> _Chain:
    """Staged and joint solution with the camera on the flange, or before it, whichever fits."""
    best: tuple[float, str, list[ScanObservation], Staged] | None = None
    for setup in ("eye_in_hand", "eye_to_hand"):
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
    return _Chain(
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
    return ScanObservation(frame.view, frame.profile, pose, 0.0, frame.path.name)


def _report_chain(chain: _Chain, frames: Sequence[RecordedFrame], result: dict[str, Any]) -> None:
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
    names = [f.path.name for f in frames]
    rows = chain.staged.plane.rows
    result["stripe_points"] = {n: len(r) for n, r in zip(names, rows, strict=True)}
    if chain.flat is not None:
        result["flatness"] = {
            **flatness_dict(chain.flat, names),
            "frame": "base" if chain.setup == "eye_in_hand" else "flange",
            "leave_one_out": None if chain.left_out is None else flatness_dict(chain.left_out, names),
            "staged": None if chain.flat_staged is None else flatness_dict(chain.flat_staged, names),
        }


def _report_plane(frames: Sequence[RecordedFrame], camera: CameraModel, result: dict[str, Any]) -> None:
    """The light plane from pictures alone, when the stripe is in them."""
    views = [f.view for f in frames if f.view is not None]
    profiles = [f.profile for f in frames]
    if sum(p is not None for p in profiles) < 2:
        result["notes"].append("no light plane: fewer than two frames show a laser stripe")
        return
    try:
        poses = [board_pose(v, camera).camera_from_board for v in views]
        plane = plane_from_board(camera, poses, views, profiles)
    except RefusedError as error:
        result["notes"].append(f"no light plane: {error}")
        return
    seen = [stripe_pixels(p, r) for p, r in zip(profiles, plane.rows, strict=True) if p is not None]
    result["light_plane"] = {
        **plane_dict(plane.plane),
        "rms_mm": 1e3 * plane.rms,
        "depth_range_mm": seen_depths(plane.plane, camera, seen),
        "method": "fit on the board's poses",
    }
    result["stripe_points"] = {f.path.name: len(r) for f, r in zip(frames, plane.rows, strict=True)}


def _from_pairs(pairs: Sequence[tuple[pin.SE3, pin.SE3]]) -> dict[str, Any]:
    """Hand-eye from pairs (base_from_flange, camera_from_board), camera on the flange or standing before the board."""
    solutions: list[tuple[str, HandEye, HandEye]] = []
    boards = [board for _, board in pairs]
    for setup in ("eye_in_hand", "eye_to_hand"):
        flanges = [f if setup == "eye_in_hand" else f.inverse() for f, _ in pairs]
        try:
            closed = solve_hand_eye(flanges, boards)
        except RefusedError as error:
            raise ConfigError(f"the {len(pairs)} pairs of poses give no hand-eye: {error}") from error
        solutions.append((setup, closed, refine_hand_eye(flanges, boards, closed)))
    setup, closed, refined = min(solutions, key=lambda s: s[1].scatter_m)
    result = empty_result(None)
    del result["frames_rms"]
    result["frames"] = [
        {"name": f"pair {k}", "used": True, "reason": None, "text": "", "rms_px": None} for k in range(len(pairs))
    ]
    result["hand_eye"] = {
        "method": "Park-Martin, then robust least squares on the poses",
        **hand_eye_dict(setup, refined.flange_from_camera),
        "scatter_mm": 1e3 * refined.scatter_m,
        "scatter_deg": math.degrees(refined.scatter_rad),
        "frames": len(pairs),
        "closed_form": closed_form_dict(setup, closed),
    }
    result["notes"].append("pairs of poses only: no intrinsics, no light plane, no flatness")
    return result
