"""A calibration from a folder of recorded frames, as `cell calibrate --from FOLDER --board SPEC --json` prints it.

With flange poses: camera, hand-eye, light plane and the flatness of the whole chain. Without: what can be had. A folder
with pairs of poses only gives the hand-eye.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.calibration.recorded.folder import RecordedFrame, poses_without_frame, read_frames, read_pose_pairs
from cell.calibration.recorded.pairs import calibrate_pairs
from cell.calibration.recorded.result import empty_result, frame_dict
from cell.calibration.recorded.solution import camera_of, solve_frames
from cell.geometry.camera import CameraModel
from cell.vision.board.spec import BoardSpec
from drivers.errors import ConfigError, RefusedError


@dataclass(frozen=True)
class CameraOptions:
    """A camera that is known already, or (`hold`) one that only the pictures may decide."""

    given: CameraModel | None = None
    hold: bool = False


def calibrate_folder(folder: Path, spec: BoardSpec | None, camera: CameraOptions | None = None) -> dict[str, Any]:
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
    - `noise`: what the adjustment assumed and found; `notes`: what could not be had, and why;
    - `checks`: `part`, `name`, `value`, `doubt_from`, `refused_from`, `unit`, `verdict` (ok, doubt, refused), `text`;
      `refused`: why, by part; a part that is refused is None, and what was found of it is in `refused_values`.

    Raises ConfigError when there is nothing to read.
    """
    pairs = read_pose_pairs(folder) if folder.is_dir() else []
    if spec is None:
        if not pairs:
            raise ConfigError(f"{folder}: name the board in the pictures with --board, such as chessboard:7x6:10mm")
        return calibrate_pairs(pairs)
    try:
        frames = read_frames(folder, spec)
    except ConfigError:
        if pairs:
            return calibrate_pairs(pairs)
        raise
    result = empty_result(spec)
    result["notes"] += [
        f"{name} is not used: no picture has its number" for name in poses_without_frame(folder, frames)
    ]
    _from_frames(frames, result, camera or CameraOptions())
    result["frames"] = [frame_dict(frame, result["frames_rms"]) for frame in frames]
    del result["frames_rms"]
    return result


def _from_frames(frames: list[RecordedFrame], result: dict[str, Any], options: CameraOptions) -> None:
    try:
        found = camera_of(frames, options.given)
    except RefusedError as error:
        result["notes"].append(f"no intrinsics: {error}")
        return
    solve_frames(frames, found, result, given=options.given, hold_camera=options.hold)
