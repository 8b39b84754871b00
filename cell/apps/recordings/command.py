"""A calibration from a folder of recorded frames, as `cell calibrate --from FOLDER --board SPEC --json` prints it.

With flange poses: camera, hand-eye, light plane and the flatness of the whole chain. Without: what can be had. A folder
with pairs of poses only gives the hand-eye.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cell.apps.recordings.attach import Options, attach_poses
from cell.apps.recordings.conventions import check_reading
from cell.apps.recordings.frames import RecordedFrame, read_frames
from cell.apps.recordings.pairs import calibrate_pairs, read_pose_pairs
from cell.apps.recordings.result import empty_result, frame_dict
from cell.apps.recordings.series import Series, in_order_of_views, list_folder, match_series, read_series
from cell.apps.recordings.solution import (
    CameraChanged,
    agreeing,
    camera_of,
    note_perhaps_no_laser,
    rough_camera,
    solve_frames,
)
from cell.measure.vision.board.view import BoardSpec
from drivers.errors import ConfigError, RefusedError


def calibrate_folder(folder: Path, spec: BoardSpec | None, options: Options | None = None) -> dict[str, Any]:
    """Calibrate from the pictures of a folder, or from its pairs of poses when `spec` is None or there are no pictures.

    Keys, all lengths in mm and angles in deg unless the key says otherwise, None for what the folder does not tell:

    - `board`; `frames`: `name`, `used`, `reason`, `text`, `rms_px`, `points`, `pose`, `pose_from`, `stripe`,
      `stripe_from`;
    - `laser`: `asked`, the `channel` in which the stripe was read, and `votes`: of the pictures `looked` at, how many
      show it best in which mix of colours; of a frame `stripe_off`, the picture without the laser, `stripe_text`, why
      its line is not taken, and `stripe_left_out`, points with a `second_line` or a `reflection`, which are not used;
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
    - `noise`: what the adjustment assumed and found; `notes`: what could not be had, and why;
    - `checks`: `part`, `name`, `value`, `doubt_from`, `refused_from`, `unit`, `verdict` (ok, doubt, refused), `text`;
      `refused`: why, by part; a part that is refused is None, and what was found of it is in `refused_values`.

    Raises ConfigError when there is nothing to read.
    """
    options = options or Options()
    check_reading(options.poses)
    pairs = read_pose_pairs(folder) if folder.is_dir() else []
    listing = list_folder(folder)
    if pairs and (spec is None or (listing.texts and not listing.pictures)):
        result = calibrate_pairs(pairs)
        return (
            result | {"hand_eye": None, "checks": [], "refused": {}, "refused_values": {}} if options.plan else result
        )
    if not listing.pictures and listing.texts:
        raise ConfigError(
            f"{folder} holds no pictures, and no JSON file with pairs of poses: for a hand-eye without pictures give "
            "a list of [base_from_flange, camera_from_board], each a 4×4 matrix in m"
        )
    if spec is None:
        count = Counter(path.parent for path in listing.pictures)
        held = ", ".join(f"{listing.name(f)} ({n})" for f, n in count.items() if f != folder)
        raise ConfigError(
            f"{folder}: name the board in the {len(listing.pictures)} pictures with --board, such as "
            "chessboard:7x6:10mm" + (f"; pictures are in {held}: --from can name one of these, too" if held else "")
        )
    series, links, unread = read_series(listing)
    belonging, strange = match_series(series, listing, links)
    # A plan tells of boards and poses; to read stripes takes seconds for each picture.
    frames, channel = read_frames(listing, spec, links, None if options.plan else options.laser, options.plan)
    late = [one for one in series if not one.of and in_order_of_views(one, frames)]
    strange = [(name, reason) for name, reason in strange if name not in [one.name for one in late]]
    result = empty_result(spec)
    asked, chosen = (str(one or "none") for one in (channel.asked, channel.chosen))
    result["laser"] = {"asked": asked, "channel": chosen, "looked": channel.looked, "votes": channel.votes}
    # Why lines on the board are not taken for the laser's: in one sentence where there may be no laser at all.
    doubtful = [f"{f.name}: no stripe: {f.stripe_text}" for f in frames if f.stripe_text]
    if len(doubtful) > 1 and not any(f.profile is not None for f in frames):
        perhaps = f"no picture shows a stripe for certain, {len(doubtful)} show a line that may be one"
        doubtful = [f"{perhaps}; {doubtful[0]}"]
    result["notes"] += doubtful
    result["unread"] = [{"name": name, "reason": reason} for name, reason in [*listing.unread, *unread, *strange]]
    _from_frames(frames, belonging + late, options, result)
    rms = result.pop("frames_rms")
    result["frames"] = [frame_dict(frame, rms) for frame in frames]
    return result


def _from_frames(
    frames: list[RecordedFrame], series: Sequence[Series], options: Options, result: dict[str, Any]
) -> None:
    notes: list[str] = result["notes"]
    found = None
    try:
        found = (rough_camera if options.plan else camera_of)(frames, options.camera)
    except CameraChanged as error:
        result["refused"]["intrinsics"] = f"no intrinsics: {error}"
    except RefusedError as error:
        notes.append(f"no intrinsics: {error}")
    understood = attach_poses(frames, series, None if found is None else found[0].camera, options)
    result["poses"] = understood.about
    notes += understood.notes
    if understood.refused:
        result["refused"]["hand_eye"] = understood.refused
    for one in series:
        if one.alone and one.name in (understood.about["source"] or []):
            several = Counter(r.path for r in one.records)
            names = [r.path.name + (f" {r.label}" if several[r.path] > 1 else "") for r in one.alone]
            notes.append(f"{', '.join(names)} not used: no picture belongs to it")
    if found is not None and options.plan:
        agreeing(frames, found[0].camera)
    elif found is not None:
        solve_frames(frames, found, result, understood.setup, given=options.camera, hold_camera=options.hold_camera)
        note_perhaps_no_laser(frames, result)
