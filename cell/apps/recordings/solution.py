"""From frames whose boards, stripes and poses were read to a result that has been checked, or refused part by part."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cell.apps.recordings.chain import (  # fmt: skip
    STRIPE_MEANS,
    Profiles,
    Rows,
    check_chain,
    of_one_plane,
    report_chain,
    solve_chain,
)
from cell.apps.recordings.consistency import refuse_misplaced, refuse_odd_ones, settle_orders
from cell.apps.recordings.frames import RecordedFrame, by_stop, counted, merged, used
from cell.apps.recordings.result import CAMERAS, intrinsics_dict, plane_dict, seen_depths
from cell.measure.calibration.judge.checks import QualityCheck, against_pictures, camera_checks, refused_parts
from cell.measure.calibration.judge.faults import FOREIGN, foreign_view, parted_at
from cell.measure.calibration.judge.plane_checks import PlaneKnown, plane_checks, planes_of_cameras, planes_without_one
from cell.measure.calibration.solve.intrinsics import Intrinsics, choose_lens, given_camera
from cell.measure.calibration.solve.starts import PlaneStart, plane_from_board, stripe_means, stripe_pixels, zhang
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardView
from cell.measure.vision.pictures import PictureRefused, Reason
from cell.measure.vision.stripe_on_board import on_plane
from drivers.errors import RefusedError

# A frame whose points miss their places by this many times the others' RMS, and by this many px, is not of this board.
ODD_RATIO, ODD_PX = 3.5, 0.4
LEAST_FRAMES = 3
# Two parts of the pictures are of two cameras where their focal lengths differ by more than both. A bent board and
# views from one side move that of few pictures by up to a hundredth.
CHANGED_SIGMAS, CHANGED_SHARE = 4.0, 0.02
# … and where one camera for both leaves so many times the squares of two; with a zoom of 2 % it leaves 1.1 times. A few
# views from one side take noise or a bend for another focal length and hardly fit better with it.
FITS_BETTER = 1.06
LIKELY_LASER = 0.5
"""Share of the pictures that shows a stripe where there was a laser."""
OBLIQUE = math.radians(75.0)


class CameraChanged(RefusedError):
    """The pictures are of two cameras, or of one whose zoom or focus was changed."""


def camera_of(frames: Sequence[RecordedFrame], given: CameraModel | None = None) -> tuple[Intrinsics, Intrinsics]:
    """Camera of all used frames, and that without distortion; frames refused whose points miss by far more than others.

    A `given` camera is taken as it is. Raises RefusedError where the frames give none.
    """
    while True:
        kept = used(frames)
        views, stops = _views(kept), by_stop(kept)
        apart = _views([merged(s) for s in stops])
        try:
            if given is None:
                # The camera of the stops with the residuals of each picture.
                found, plain = choose_lens(apart)
                chosen, plain = (
                    replace(c, view_rms=np.array([board_pose(view, c.camera).rms_px for view in views]))
                    for c in (found, plain)
                )
                _refuse_change(chosen, apart, [s[0].name for s in stops])
            else:
                chosen = plain = given_camera(given, views)
        except PictureRefused:
            # One picture whose pose nobody can tell must not take the camera of the others.
            rough = zhang(apart, lens=False) if given is None else given
            for frame in kept:
                try:
                    board_pose(_view(frame), rough)
                except PictureRefused as refused:
                    frame.refuse(refused.reason, str(refused))
            if len(used(kept)) == len(kept):
                raise
            continue
        worst, typical = int(np.argmax(chosen.view_rms)), float(np.median(chosen.view_rms))
        if chosen.view_rms[worst] > max(ODD_RATIO * typical, ODD_PX) and len(kept) > LEAST_FRAMES:
            kept[worst].refuse(
                Reason.RESIDUAL,
                f"the board's points miss their places by {math.sqrt(2) * chosen.view_rms[worst]:.2f} px, in the other "
                f"frames by {math.sqrt(2) * typical:.2f} px: is it another board, bent, or moved in the exposure?",
            )
            continue
        foreign = foreign_view(chosen, apart) if given is None else None
        if foreign is not None:
            for frame in stops[foreign[0]]:
                frame.refuse(
                    Reason.RESIDUAL,
                    f"with a camera of its own its points fit {foreign[1]:.0f} times better than chance would have it "
                    f"(usual below {FOREIGN:.0f}), and those of no other picture do: was it taken by another camera, "
                    "or with another zoom, focus or crop?",
                )
            continue
        for frame in kept:
            angle = board_pose(_view(frame), chosen.camera).obliquity
            if angle > OBLIQUE:
                text = f"the board is seen {math.degrees(angle):.0f}° from square, allowed are 75°"
                frame.refuse(Reason.OBLIQUE, text)
        if len(used(kept)) == len(kept):
            return chosen, plain


def rough_camera(frames: Sequence[RecordedFrame], given: CameraModel | None) -> tuple[Intrinsics, Intrinsics]:
    """A camera in closed form, without its lens: enough to tell how poses are to be read. Raises RefusedError."""
    views = _views([merged(stop) for stop in by_stop(used(frames))])
    return (given_camera(zhang(views, lens=False) if given is None else given, views),) * 2


def _refuse_change(found: Intrinsics, views: Sequence[BoardView], names: Sequence[str]) -> None:
    """CameraChanged where the pictures from one on are of another camera than those before, by the cameras of both."""

    def squares(views: Sequence[BoardView], camera: CameraModel) -> float:
        """Sum of the squares in px² by which the views' points miss their places in a camera."""
        return sum(2 * len(v.ids) * board_pose(v, camera).rms_px ** 2 for v in views)

    roomy = replace(found, model=replace(found.model, k1=True, k2=True, one_focal=False))
    for at in parted_at(roomy, views):
        before, after = choose_lens(views[:at])[0], choose_lens(views[at:])[0]
        apart = squares(views[:at], before.camera) + squares(views[at:], after.camera)
        if squares(views, found.camera) < FITS_BETTER * apart:
            continue
        focal, sigma = (before.camera.fx, after.camera.fx), (before.sigma[0], after.sigma[0])
        if abs(focal[1] - focal[0]) > max(CHANGED_SIGMAS * float(np.hypot(*sigma)), CHANGED_SHARE * focal[0]):
            raise CameraChanged(
                f"the pictures up to {names[at - 1]} give fx = {focal[0]:.0f} ± {sigma[0]:.0f} px, those from "
                f"{names[at]} on {focal[1]:.0f} ± {sigma[1]:.0f} px: zoom, focus or camera were changed in between; "
                "give both parts by themselves, each in a folder of its own"
            )


def _view(frame: RecordedFrame) -> BoardView:
    assert frame.view is not None
    return frame.view


def _views(frames: Sequence[RecordedFrame]) -> list[BoardView]:
    return [f.view for f in frames if f.view is not None]


def agreeing(frames: Sequence[RecordedFrame], camera: CameraModel) -> list[RecordedFrame]:
    """The used frames with a pose that agrees with those of the others; what does not is refused by name."""
    posed = [f for f in used(frames) if f.base_from_flange is not None]
    settle_orders(posed, camera)
    return refuse_misplaced(refuse_odd_ones(posed, camera), camera)


def solve_frames(
    frames: Sequence[RecordedFrame],
    found: tuple[Intrinsics, Intrinsics],
    result: dict[str, Any],
    setup: str | None = None,
    given: CameraModel | None = None,
    hold_camera: bool = False,
) -> None:
    """Put camera, hand-eye, light plane and their checks into the result; a part that fails a check is refused.

    `found` is the camera of the frames as `camera_of` gave it; `setup` says where the camera is if that is known. With
    `hold_camera` the arm has no say in the camera.
    """
    chosen, plain = found
    notes: list[str] = result["notes"]
    told = sum(f.base_from_flange is not None for f in used(frames))
    posed = agreeing(frames, chosen.camera)
    left_out, checks = told - len(posed), []
    if posed and left_out:
        # A few are slips.
        name, text = "frames whose pose disagrees with the others", (
            f"{left_out} of {told} are left out for it, too many for slips: was the camera's zoom, focus or mount, or "
            "the place of the board or of the arm's base, changed in between? Then calibrate each part by itself"
        )  # fmt: skip
        share = 100 * left_out / told
        checks = [QualityCheck("hand_eye", name, share, doubt=25.0, refuse=40.0, unit="%", says=text)]
        checks.append(QualityCheck("intrinsics", name, share, doubt=25.0, refuse=math.inf, unit="%", says=text))
    if len(used(frames)) < len(chosen.view_rms):
        try:
            chosen, plain = camera_of(frames, given)
        except RefusedError as error:
            notes.append(f"no intrinsics: {error}")
            return
        posed = [f for f in posed if f.reason is None]
    rest = used(frames)
    for frame, rms in zip(rest, chosen.view_rms, strict=True):
        frame.rms_px = math.sqrt(2) * float(rms)
    stops = [merged(stop) for stop in by_stop(rest)]
    if len(stops) < len(rest):
        same = "pictures of one stop share its error and count as one frame, their mean"
        notes.append(f"{counted(len(rest), len(stops))}: {same}")
    views = _views(stops)
    if given is not None:
        chosen, beside = against_pictures(chosen, views)
        plain, checks = chosen, beside + checks
    result["intrinsics"] = result["intrinsics_from_pictures"] = intrinsics_dict(chosen)
    result["intrinsics_without_distortion"] = intrinsics_dict(plain)
    checks += camera_checks(chosen, views, [f.name for f in stops], given=given is not None)
    if posed:
        if len(rest) > len(posed):
            more = len(rest) - len(posed)
            notes.append(f"{more} used frames have no flange pose: they count for the intrinsics only")
        hold = hold_camera or given is not None
        try:
            chain = solve_chain([merged(stop) for stop in by_stop(posed)], chosen, setup, hold)
            checks += check_chain(chain, chosen)
            report_chain(chain, chosen, result)
        except (RefusedError, np.linalg.LinAlgError) as error:
            result["refused"]["hand_eye"] = f"no hand-eye: {error}"
    else:
        notes.append("no used frame has a flange pose: no hand-eye, no flatness")
    if result["light_plane"] is None and result["hand_eye"] is None:
        checks += _report_plane(stops, chosen, result)
    apply_checks(checks, result)


def note_perhaps_no_laser(frames: Sequence[RecordedFrame], result: dict[str, Any]) -> None:
    """Where few pictures show a line, and these are of no plane, there may be no laser: that is noted, not refused."""
    frames = used(frames)
    why, lit = result["refused"].get("light_plane"), [f for f in frames if f.profile is not None]
    asked = result["laser"]["asked"] != "auto" or any(f.stripe_from for f in lit)
    if why is None or asked or "intrinsics" in result["refused"] or len(lit) >= LIKELY_LASER * len(frames):
        return
    del result["refused"]["light_plane"]
    result["notes"].append(
        f"no light plane: {len(lit)} of {len(frames)} pictures show a line that might be a laser's, and these lines "
        f"are of no light plane: {why}. Where there was a laser, name its colour with --laser"
    )


def apply_checks(checks: Sequence[QualityCheck], result: dict[str, Any]) -> None:
    """Write the checks into the result, say what is doubtful, and take out what is refused.

    What was found of a refused part stays beside the reason, under `refused_values`, where nobody takes it unawares.
    A light plane and a hand-eye rest on the camera: they are refused with it.
    """
    result["checks"] = [check.as_dict() for check in checks]
    result["notes"] += [f"doubtful: {check.text}" for check in checks if check.verdict == "doubt"]
    failed = {part: "; ".join(check.text for check in found) for part, found in refused_parts(checks).items()}
    gone = dict(failed)
    if "intrinsics" in failed:
        for part in ("hand_eye", "light_plane"):
            if result[part] is not None:
                rests = f"{part.replace('_', '-')}: it rests on the camera, which is refused"
                failed.setdefault(part, rests)
        gone = dict.fromkeys(CAMERAS[1:], "") | failed
    result["refused"] |= failed
    for part in gone:
        result["refused_values"][part] = result[part]
        result[part] = None
    if "hand_eye" in failed or "light_plane" in failed:
        result["flatness"] = None


def _report_plane(frames: Sequence[RecordedFrame], pictures: Intrinsics, result: dict[str, Any]) -> list[QualityCheck]:
    """The light plane from pictures alone, when the stripe is in them, and its checks."""
    camera, views, wrong = pictures.camera, _views(frames), dict[int, str]()
    profiles = [f.profile for f in frames]
    if sum(p is not None for p in profiles) < 2:
        result["notes"].append("no light plane: fewer than two frames show a laser stripe")
        return []
    poses = [board_pose(v, camera).camera_from_board for v in views]

    def fit(lit: Profiles) -> tuple[PlaneStart, Rows, Sequence[Array]]:
        plane = plane_from_board(camera, poses, views, lit)
        on_boards = [
            np.zeros((0, 3)) if p is None or not len(r) else on_plane(camera, pose, stripe_pixels(p, r))
            for p, r, pose in zip(lit, plane.rows, poses, strict=True)
        ]
        return plane, plane.rows, on_boards

    try:
        plane, clouds = of_one_plane(profiles, camera, fit, wrong)
    except RefusedError as error:
        result["refused"]["light_plane"] = f"no light plane: {error}"
        return []
    finally:
        result["notes"] += [f"{frames[k].name}: {text} Its stripe is not used." for k, text in wrong.items()]
    profiles = [None if k in wrong else p for k, p in enumerate(profiles)]
    both = [(p, r) for p, r in zip(profiles, plane.rows, strict=True) if p is not None and len(r)]
    noise = [float(np.mean(stripe_means(p, r, STRIPE_MEANS)[1] ** 2)) for p, r in both]
    cloud: Array = np.concatenate(clouds)
    moved = planes_of_cameras(pictures, views, profiles, plane.rows)
    known = PlaneKnown.of(plane.plane, planes_without_one(clouds), cloud, moved)
    own = float(np.sqrt(np.mean(noise))) * float(np.median(cloud[:, 2])) / camera.fx
    depths = seen_depths(plane.plane, camera, [stripe_pixels(p, r) for p, r in both])
    result["light_plane"] = plane_dict("fit on the board's poses", plane.plane, plane.rms, own, known, depths=depths)
    result["stripe_points"] = {f.name: len(r) for f, r in zip(frames, plane.rows, strict=True)}
    return plane_checks(plane.rms, own, cloud, frames=len(both), known=known, left_out=len(wrong))
