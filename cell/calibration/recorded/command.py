"""A calibration from a folder of recorded frames, as `cell calibrate --from FOLDER --board SPEC --json` prints it.

With flange poses: camera, hand-eye, light plane and the flatness of the whole chain. Without: what can be had. A folder
with pairs of poses only gives the hand-eye.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cell.calibration.recorded.attach import LEAST_POSES, Options, attach_poses
from cell.calibration.recorded.chain import report_chain, solve_chain
from cell.calibration.recorded.conventions import check_reading
from cell.calibration.recorded.folder import RecordedFrame, read_frames, read_pose_pairs, used
from cell.calibration.recorded.listing import list_folder
from cell.calibration.recorded.pairs import calibrate_pairs
from cell.calibration.recorded.result import empty_result, frame_dict, intrinsics_dict, plane_dict, seen_depths
from cell.calibration.recorded.series import Series, match_series, read_series
from cell.calibration.solve.consistency import refuse_misplaced, refuse_odd_ones, settle_orders
from cell.calibration.solve.intrinsics import Intrinsics, choose_lens
from cell.calibration.solve.starts import plane_from_board, stripe_pixels
from cell.geometry.camera import CameraModel
from cell.vision.board.board import board_pose
from cell.vision.board.spec import BoardSpec
from cell.vision.pictures import Reason
from drivers.errors import ConfigError, RefusedError

# A frame whose points miss their places by this many times the others' RMS, and by this many px, is not of this board.
ODD_RATIO, ODD_PX = 3.5, 0.4
OBLIQUE = math.radians(75.0)


def calibrate_folder(folder: Path, spec: BoardSpec | None, options: Options | None = None) -> dict[str, Any]:
    """Calibrate from the pictures of a folder, or from its pairs of poses when `spec` is None or there are no pictures.

    Keys, all lengths in mm and angles in deg unless the key says otherwise, None for what the folder does not tell:

    - `board`; `frames`: `name`, `used`, `reason`, `text`, `rms_px`, `points`, `pose`, `pose_from`, `stripe`,
      `stripe_from`;
    - `poses`: how the flange poses were read: `source`, `reading`, `unit`, `setup`, `matched_by`, `evidence`;
    - `unread`: `name` and `reason` of each file that was not understood;
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
    options = options or Options()
    check_reading(options.poses)
    pairs = read_pose_pairs(folder) if folder.is_dir() else []
    if spec is None:
        if not pairs:
            raise ConfigError(f"{folder}: name the board in the pictures with --board, such as chessboard:7x6:10mm")
        return calibrate_pairs(pairs)
    listing = list_folder(folder)
    if pairs and not listing.pictures:
        return calibrate_pairs(pairs)
    series, links, unread = read_series(listing)
    belonging, strange = match_series(series, listing, links)
    frames = read_frames(listing, spec, links)
    result = empty_result(spec)
    result["unread"] = [{"name": name, "reason": reason} for name, reason in [*listing.unread, *unread, *strange]]
    _from_frames(frames, belonging, options, result)
    result["frames"] = [frame_dict(frame, result["frames_rms"]) for frame in frames]
    del result["frames_rms"]
    return result


def _from_frames(
    frames: list[RecordedFrame], series: Sequence[Series], options: Options, result: dict[str, Any]
) -> None:
    notes: list[str] = result["notes"]
    found: tuple[Intrinsics, Intrinsics] | None = None
    try:
        found = _camera(frames)
    except RefusedError as error:
        notes.append(f"no intrinsics: {error}")
    understood = attach_poses(frames, series, None if found is None else found[0].camera, options)
    result["poses"] = understood.about
    notes += understood.notes
    for one in series:
        if one.alone and one.name in (understood.about["source"] or []):
            names = [
                r.path.name if sum(r.path == o.path for o in one.records) == 1 else f"{r.path.name} {r.label}"
                for r in one.alone
            ]
            notes.append(f"{', '.join(names)} not used: no picture belongs to it")
    if found is None:
        return
    chosen, plain = found
    posed = [f for f in used(frames) if f.base_from_flange is not None]
    if len(posed) >= LEAST_POSES:
        settle_orders(posed, chosen.camera)
        posed = refuse_misplaced(refuse_odd_ones(posed, chosen.camera), chosen.camera)
    if options.plan:
        return
    if len(used(frames)) < len(chosen.view_rms):
        try:
            chosen, plain = _camera(frames)
        except RefusedError as error:
            notes.append(f"no intrinsics: {error}")
            return
        posed = [f for f in posed if f.reason is None]
    rest = used(frames)
    result["frames_rms"] = {f.name: math.sqrt(2) * r for f, r in zip(rest, chosen.view_rms, strict=True)}
    result["intrinsics"] = result["intrinsics_from_pictures"] = intrinsics_dict(chosen)
    result["intrinsics_without_distortion"] = intrinsics_dict(plain)
    if len(posed) >= LEAST_POSES:
        without_pose = len(rest) - len(posed)
        if without_pose:
            notes.append(f"{without_pose} used frames have no flange pose: they count for the intrinsics only")
        try:
            report_chain(solve_chain(posed, understood.setup), posed, result)
            return
        except (RefusedError, np.linalg.LinAlgError) as error:
            notes.append(f"no hand-eye: {error}")
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
    result["stripe_points"] = {f.name: len(r) for f, r in zip(frames, plane.rows, strict=True)}
