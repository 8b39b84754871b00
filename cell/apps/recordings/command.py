"""A calibration from a folder of recorded frames, as `cell calibrate --from FOLDER --board SPEC --json` prints it.

With flange poses: camera, hand-eye, light plane and the flatness of the whole chain. Without: what can be had. A folder
with pairs of poses only gives the hand-eye.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.apps.recordings import solution
from cell.apps.recordings.agreement import UNITS, Decision, decide, scale_problem
from cell.apps.recordings.conventions import check_reading, why_not
from cell.apps.recordings.frames import SAME_RAD, RecordedFrame, near, read_frames
from cell.apps.recordings.pairs import Pair, calibrate_pairs, read_pose_pairs
from cell.apps.recordings.result import Figures, RecordedResult
from cell.apps.recordings.series import Listing, Series, in_order_of_views, list_folder, match_series, read_series
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.poses import difference, from_parts
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardSpec
from cell.measure.vision.pictures import PictureRefused, Reason
from cell.measure.vision.stripe.planes import LaserChannel
from drivers.errors import ConfigError, RefusedError

LEAST_POSES, FARTHEST_M = 3, 20.0


@dataclass
class Options:
    """What a person said instead of leaving it to the data; None where nothing was said.

    `poses` is a reading's name (`conventions.TRIED`), `pose_field` a series of poses, `setup` eye_in_hand or
    eye_to_hand; `plan`: only say what was understood. `camera` is known already; with `hold_camera` the arm has no say
    in it. `laser`: the channel in which its stripe is read, None for none.
    """

    poses: str | None = None
    pose_field: str | None = None
    setup: str | None = None
    plan: bool = False
    camera: CameraModel | None = None
    hold_camera: bool = False
    laser: LaserChannel | None = LaserChannel.AUTO


def calibrate_folder(folder: Path, spec: BoardSpec | None, options: Options | None = None) -> RecordedResult:
    """Calibrate from the pictures of a folder, or from its pairs of poses when `spec` is None or there are no pictures.
    Raises ConfigError when there is nothing to read."""
    options = options or Options()
    check_reading(options.poses)
    listing = list_folder(folder)
    pairs = read_pose_pairs(listing)
    if pairs and (spec is None or not listing.pictures):
        return _of_pairs(pairs, listing, options)
    if spec is None or (listing.texts and not listing.pictures):
        raise ConfigError(_what_is_missing(listing))
    series, links, unread = read_series(listing)
    belonging, strange = match_series(series, listing, links)
    # A plan tells of boards and poses; to read stripes takes seconds for each picture.
    frames, channel = read_frames(listing, spec, links, None if options.plan else options.laser)
    late = [one for one in series if not one.of and in_order_of_views(one, frames)]
    unread += [(name, reason) for name, reason in strange if name not in [one.name for one in late]]
    result = RecordedResult(spec.name, laser=channel.figures())
    result.notes += _doubtful_lines(frames)
    result.unread = [{"name": name, "reason": reason} for name, reason in [*listing.unread, *unread]]
    _from_frames(frames, [*belonging, *late], options, result)
    result.frames = [frame.figures() for frame in frames]
    return result


def _of_pairs(pairs: Sequence[Pair], listing: Listing, options: Options) -> RecordedResult:
    """The hand-eye of pairs of poses. Raises ConfigError for what a person said that these have nothing of."""
    laser = None if options.laser is LaserChannel.AUTO else "said"
    of = {"poses": options.poses, "pose-field": options.pose_field, "camera": options.camera, "laser": laser}
    if given := [f"--{name}" for name, value in of.items() if value is not None]:
        raise ConfigError(f"{', '.join(given)}: {listing.folder} holds pairs of poses in m, no pictures; leave it out")
    result = calibrate_pairs(pairs, options.setup)
    if listing.pictures:
        result.notes.append(f"{len(listing.pictures)} pictures were not looked at: --board names no board of them")
    return RecordedResult(frames=result.frames, notes=result.notes) if options.plan else result


def _what_is_missing(listing: Listing) -> str:
    """Why a folder without a board's name, or without pictures, is not read."""
    if listing.texts and not listing.pictures:
        return (
            f"{listing.folder} holds no pictures, and no JSON file with pairs of poses: for a hand-eye without "
            "pictures give a list of [base_from_flange, camera_from_board], each a 4×4 matrix in m"
        )
    count = Counter(path.parent for path in listing.pictures)
    held = ", ".join(f"{listing.name(f)} ({n})" for f, n in count.items() if f != listing.folder)
    return (
        f"{listing.folder}: name the board in the {len(listing.pictures)} pictures with --board, such as "
        "chessboard:7x6:10mm" + (f"; pictures are in {held}: --from can name one of these, too" if held else "")
    )


def _doubtful_lines(frames: Sequence[RecordedFrame]) -> list[str]:
    """Why lines on the board are not taken for the laser's: one sentence where there may be no laser at all."""
    doubtful = [f"{f.name}: no stripe: {f.stripe_text}" for f in frames if f.stripe_text]
    if len(doubtful) > 1 and not any(f.profile is not None for f in frames):
        perhaps = f"no picture shows a stripe for certain, {len(doubtful)} show a line that may be one"
        return [f"{perhaps}; {doubtful[0]}"]
    return doubtful


def _from_frames(
    frames: Sequence[RecordedFrame], series: Sequence[Series], options: Options, result: RecordedResult
) -> None:
    cameras = None
    try:
        cameras = (solution.rough_camera if options.plan else solution.camera_of)(frames, options.camera)
    except solution.CameraChanged as error:
        result.refused["intrinsics"] = f"no intrinsics: {error}"
    except RefusedError as error:
        result.notes.append(f"no intrinsics: {error}")
    understood = attach_poses(frames, series, None if cameras is None else cameras[0].camera, options)
    result.poses = understood.about
    result.notes += understood.notes
    if understood.refused:
        result.refused["hand_eye"] = understood.refused
    if cameras is not None and options.plan:
        solution.agreeing(frames, cameras[0].camera)
    elif cameras is not None:
        hold, setup = options.hold_camera, understood.setup
        solution.solve_frames(frames, cameras, result, setup=setup, given=options.camera, hold_camera=hold)
        if options.laser is LaserChannel.AUTO:
            solution.note_perhaps_no_laser(frames, result)


@dataclass
class Understood:
    """How the poses of a folder were read, and in which series; `refused`: why there are some, and none can be used."""

    series: Sequence[Series]
    setup: str = "eye_in_hand"
    about: Figures = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    refused: str = ""


def attach_poses(
    frames: Sequence[RecordedFrame], series: Sequence[Series], camera: CameraModel | None, options: Options
) -> Understood:
    """Set each frame's pose, in m, by the reading that agrees with the boards in the pictures, and tell how. Without a
    camera, or with fewer than three frames, nothing is decided and no frame gets a pose."""
    if options.pose_field is not None:
        names = ", ".join(s.name for s in series)
        series = [s for s in series if s.name == options.pose_field]
        if not series:
            text = f"--pose-field {options.pose_field}: no such poses belong to the pictures; there are {names}"
            raise ConfigError(text)
    if not series:
        return Understood([], about={"source": None}, notes=["no flange poses were found that belong to the pictures"])
    for one in series:
        _settle(one, frames, len(series) == 1)
    undecided = Understood(series, about={"source": [s.name for s in series]})
    understood = undecided if camera is None else _understand(frames, undecided, camera, options)
    for one in understood.series:
        if one.alone:
            names = ", ".join(one.named(record) for record in one.alone)
            understood.notes.append(f"{names} not used: no picture belongs to it")
    return understood


def _understand(
    frames: Sequence[RecordedFrame], understood: Understood, camera: CameraModel, options: Options
) -> Understood:
    """The reading of the poses by the boards in the pictures; as it was where nothing can be decided."""
    boards = {}
    for k, frame in enumerate(frames):
        if frame.view is None or frame.reason is not None or not any(k in s.of for s in understood.series):
            continue
        try:
            boards[k] = [board_pose(view, camera).camera_from_board for view in frame.view.turns()]
        except PictureRefused as refused:
            frame.refuse(refused.reason, str(refused))
    if len(boards) < LEAST_POSES:
        few = f"{len(boards)} used frames have a flange pose, at least {LEAST_POSES} are needed"
        understood.notes.append(f"{few}: no hand-eye, no flatness")
        return understood
    try:
        pitch = next(f.view.spec.pitch for f in frames if f.view is not None)
        decision = decide(understood.series, boards, pitch, options.poses, options.setup)
    except RefusedError as error:
        understood.refused = f"no hand-eye: {error}"
        return understood
    return _apply(decision, frames, pitch, options)


def _settle(one: Series, frames: Sequence[RecordedFrame], only: bool) -> None:
    """Refuse frames that have two poses, and give one without a pose that of another picture of its place."""
    for k, records in one.doubled.items():
        if only and frames[k].reason is None:
            names = ", ".join(dict.fromkeys(f"{r.path.name} {r.label or ''}".strip() for r in records))
            frames[k].refuse(Reason.NO_POSE, f"{len(records)} poses are named like it: {names}; which one is it?")
    index = {id(frame): k for k, frame in enumerate(frames)}
    for k, frame in enumerate(frames):
        if frame.shows is not None and k in one.of and index[id(frame.shows)] not in one.doubled:
            one.of.setdefault(index[id(frame.shows)], one.of[k])


def _apply(decision: Decision, frames: Sequence[RecordedFrame], pitch: float, options: Options) -> Understood:
    best = decision.best
    one, poses = best.series, best.series.poses(best.reading)
    about: Figures = {
        "source": [one.name], "reading": best.reading.name, "text": best.reading.text, "unit": best.unit,
        "setup": best.setup, "matched_by": one.by,
        "given": [n for n in ("poses", "pose_field", "setup") if getattr(options, n)], "evidence": decision.evidence,
        "turn_deg": float(np.degrees(best.turn)), "shift_mm": 1e3 * best.shift,
    }  # fmt: skip
    own = "not used: its poses are those of the board as the camera sees it, not of the flange"
    understood = Understood([one], best.setup, about, [f"{name} {own}" for name in decision.boards_own])
    problem, refused = scale_problem(best, pitch)
    if refused:
        understood.refused = f"no hand-eye: {problem}"
    elif problem:
        understood.notes.append(f"doubt: {problem}")
    for k, record in one.of.items():
        frames[k].pose_from = one.named(record)
        if k in poses:
            _take_pose(frames[k], from_parts(UNITS[best.unit] * poses[k].translation, poses[k].rotation), best.unit)
        elif frames[k].reason in (None, Reason.DUPLICATE):
            why = why_not(record.numbers, record.named, best.reading.name)
            frames[k].refuse(Reason.NO_POSE, f"{frames[k].pose_from}: {why}")
        if refused:
            frames[k].base_from_flange = None
    _compare_copies(frames)
    return understood


def _take_pose(frame: RecordedFrame, pose: pin.SE3, unit: str) -> None:
    """Keep a flange pose, or refuse the frame where it is out of every arm's reach."""
    far = float(np.linalg.norm(pose.translation))
    if far <= FARTHEST_M:
        frame.base_from_flange = pose
    elif frame.reason is None:
        text = f"the flange is {far:.0f} m from the base, read in {unit} like the others (allowed"
        text += f" {FARTHEST_M:.0f} m): is its position in another unit? Correct it"
        frame.refuse(Reason.NO_POSE, f"{frame.pose_from}: {text}")


def _compare_copies(frames: Sequence[RecordedFrame]) -> None:
    """Refuse pictures that show what another shows, and have another pose; a stripe that is theirs is not used."""
    for frame in frames:
        first, own = frame.shows, frame.base_from_flange
        if first is None or own is None or first.base_from_flange is None:
            continue
        if near(first.base_from_flange, own, turn=2 * SAME_RAD):
            continue
        apart = difference(first.base_from_flange, own)
        way, turn = float(np.linalg.norm(apart[:3])), float(np.linalg.norm(apart[3:]))
        off = f"{1e3 * way:.1f} mm and {np.degrees(turn):.2f}°"
        text = f"its pose ({frame.pose_from}) is {off} from that of {first.name}"
        if first.stripe_from == frame.name:
            first.profile, first.stripe_from, first.stripe_off = None, "", ""
            first.stripe_text = f"{frame.name} was not taken at the same place: {text}"
        frame.refuse(Reason.NO_POSE, f"{frame.text}, but {text} ({first.pose_from}): which one is right?")
