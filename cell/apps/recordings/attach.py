"""Give each recorded frame its flange pose: find the poses, decide how to read them, and say what was understood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from cell.apps.recordings.agreement import UNITS, Decision, decide, scale_problem
from cell.apps.recordings.conventions import why_not
from cell.apps.recordings.frames import RecordedFrame
from cell.apps.recordings.series import Series
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.poses import from_parts
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.pictures import PictureRefused, Reason
from cell.measure.vision.stripe.planes import LaserChannel
from drivers.errors import ConfigError, RefusedError

LEAST_POSES, FARTHEST_M = 3, 20.0
# Poses of an arm that stands still, read twice, are no further apart.
SAME_M, SAME_RAD = 0.5e-3, 2e-3


@dataclass
class Options:
    """What a person said instead of leaving it to the data; None where nothing was said.

    `poses` is a reading's name (`conventions.TRIED`), `pose_field` a series of poses, `setup` eye_in_hand or
    eye_to_hand; `plan`: only say what was understood. `camera` is known already; with
    `hold_camera` the arm has no say in it. `laser`: the channel in which its stripe is read, None for none.
    """

    poses: str | None = None
    pose_field: str | None = None
    setup: str | None = None
    plan: bool = False
    camera: CameraModel | None = None
    hold_camera: bool = False
    laser: LaserChannel | None = LaserChannel.AUTO


@dataclass
class Understood:
    """How the poses of a folder were read; `refused`: why there are poses, and none can be used."""

    setup: str | None = None
    about: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    refused: str = ""


def attach_poses(
    frames: Sequence[RecordedFrame], series: Sequence[Series], camera: CameraModel | None, options: Options
) -> Understood:
    """Set each frame's pose, in m, by the reading that agrees with the boards in the pictures, and tell how.

    Without a camera, or with fewer than three frames, nothing is decided and no frame gets a pose.
    """
    if options.pose_field is not None:
        names = ", ".join(s.name for s in series)
        series = [s for s in series if s.name == options.pose_field]
        if not series:
            text = f"--pose-field {options.pose_field}: no such poses belong to the pictures; there are {names}"
            raise ConfigError(text)
    if not series:
        return Understood(about={"source": None}, notes=["no flange poses were found that belong to the pictures"])
    for one in series:
        _settle(one, frames, len(series) == 1)
    understood = Understood(about={"source": [s.name for s in series]})
    if camera is None:
        return understood
    boards = {}
    for k, frame in enumerate(frames):
        if frame.view is None or frame.reason is not None or not any(k in s.of for s in series):
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
        decision = decide(series, boards, pitch, options.poses, options.setup)
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
    about = {
        "source": [one.name],
        "reading": best.reading.name,
        "text": best.reading.text,
        "unit": best.unit,
        "setup": best.setup,
        "matched_by": one.by,
        "given": [n for n in ("poses", "pose_field", "setup") if getattr(options, n)],
        "evidence": decision.evidence,
        "turn_deg": float(np.degrees(best.turn)),
        "shift_mm": 1e3 * best.shift,
    }
    own = "not used: its poses are those of the board as the camera sees it, not of the flange"
    understood = Understood(best.setup, about, [f"{name} {own}" for name in decision.boards_own])
    problem, refused = scale_problem(best, pitch)
    if refused:
        understood.refused = f"no hand-eye: {problem}"
    elif problem:
        understood.notes.append(f"doubt: {problem}")
    for k, record in one.of.items():
        frame, pose = frames[k], poses.get(k)
        several = sum(r.path == record.path for r in one.records) > 1
        frame.pose_from = record.path.name + (f" {record.label}" if several and record.label else "")
        if pose is None:
            if frame.reason in (None, Reason.DUPLICATE):
                why = why_not(record.numbers, record.named, best.reading.name)
                frame.refuse(Reason.NO_POSE, f"{frame.pose_from}: {why}")
            continue
        place = UNITS[best.unit] * pose.translation
        far = float(np.linalg.norm(place))
        if far > FARTHEST_M:
            if frame.reason is None:
                text = f"the flange is {far:.0f} m from the base, read in {best.unit} like the others (allowed"
                text += f" {FARTHEST_M:.0f} m): is its position in another unit? Correct it"
                frame.refuse(Reason.NO_POSE, f"{frame.pose_from}: {text}")
        elif not refused:
            frame.base_from_flange = from_parts(place, pose.rotation)
    _compare_copies(frames)
    return understood


def _compare_copies(frames: Sequence[RecordedFrame]) -> None:
    """Refuse pictures that show what another shows, and have another pose; a stripe that is theirs is not used."""
    for frame in frames:
        first, own = frame.shows, frame.base_from_flange
        if first is None or own is None or first.base_from_flange is None:
            continue
        apart = first.base_from_flange.actInv(own)
        way, turn = float(np.linalg.norm(apart.translation)), float(np.linalg.norm(pin.log3(apart.rotation)))
        if way < SAME_M and turn < SAME_RAD:
            continue
        off = f"{1e3 * way:.1f} mm and {np.degrees(turn):.2f}°"
        text = f"its pose ({frame.pose_from}) is {off} from that of {first.name}"
        if first.stripe_from == frame.name:
            first.profile, first.stripe_from, first.stripe_off = None, "", ""
            first.stripe_text = f"{frame.name} was not taken at the same place: {text}"
        frame.refuse(Reason.NO_POSE, f"{frame.text}, but {text} ({first.pose_from}): which one is right?")
