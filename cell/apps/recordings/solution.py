"""From frames whose boards, stripes and poses were read to a result that has been checked, or refused part by part."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.apps.recordings.chain import check_chain, pictures_figures, plane_of_pictures, report_chain, solve_chain
from cell.apps.recordings.consistency import refuse_misplaced, refuse_odd_ones, settle_orders
from cell.apps.recordings.frames import RecordedFrame, by_stop, counted, merged, used
from cell.apps.recordings.result import RecordedResult
from cell.measure.calibration.judge.checks import QualityCheck, against_pictures, camera_checks
from cell.measure.calibration.judge.faults import FOREIGN, foreign_view, parted_at
from cell.measure.calibration.solve.intrinsics import Intrinsics, choose_lens, given_camera
from cell.measure.calibration.solve.starts import zhang
from cell.measure.geometry.camera import CameraModel
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardView
from cell.measure.vision.pictures import PictureRefused, Reason
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
Cameras = tuple[Intrinsics, Intrinsics]
"""The camera of the pictures, and that without distortion."""


class CameraChanged(RefusedError):
    """The pictures are of two cameras, or of one whose zoom or focus was changed."""


def camera_of(frames: Sequence[RecordedFrame], given: CameraModel | None = None) -> Cameras:
    """Camera of all used frames, and that without distortion; frames refused whose points miss by far more than others.
    A `given` camera is taken as it is. Raises RefusedError where the frames give none."""
    while True:
        kept = used(frames)
        try:
            cameras = _camera(kept, given)
        except PictureRefused:
            # One picture whose pose nobody can tell must not take the camera of the others.
            if not _refuse_poseless(kept, given):
                raise
            continue
        if not _refuse_strange(kept, cameras[0], given):
            return cameras


def _camera(kept: Sequence[RecordedFrame], given: CameraModel | None) -> Cameras:
    """The camera of the stops with the residuals of each picture."""
    views, stops = _views(kept), by_stop(kept)
    if given is not None:
        return (given_camera(given, views),) * 2
    apart = _views([merged(stop) for stop in stops])
    chosen, plain = (
        replace(c, view_rms=np.array([board_pose(view, c.camera).rms_px for view in views])) for c in choose_lens(apart)
    )
    _refuse_change(chosen, apart, [stop[0].name for stop in stops])
    return chosen, plain


def _refuse_poseless(kept: Sequence[RecordedFrame], given: CameraModel | None) -> bool:
    """Refuse frames whose board's pose cannot be told; whether there are any."""
    rough = zhang(_views([merged(stop) for stop in by_stop(kept)]), lens=False) if given is None else given
    for frame, view in zip(kept, _views(kept), strict=True):
        try:
            board_pose(view, rough)
        except PictureRefused as refused:
            frame.refuse(refused.reason, str(refused))
    return len(used(kept)) < len(kept)


def _refuse_strange(kept: Sequence[RecordedFrame], chosen: Intrinsics, given: CameraModel | None) -> bool:
    """Refuse frames of another board or camera, or seen from too far aside; whether there are any."""
    worst, typical = int(np.argmax(chosen.view_rms)), float(np.median(chosen.view_rms))
    if chosen.view_rms[worst] > max(ODD_RATIO * typical, ODD_PX) and len(kept) > LEAST_FRAMES:
        kept[worst].refuse(
            Reason.RESIDUAL,
            f"the board's points miss their places by {math.sqrt(2) * chosen.view_rms[worst]:.2f} px, in the other "
            f"frames by {math.sqrt(2) * typical:.2f} px: is it another board, bent, or moved in the exposure?",
        )
        return True
    stops = by_stop(kept)
    foreign = foreign_view(chosen, _views([merged(stop) for stop in stops])) if given is None else None
    if foreign is not None:
        for frame in stops[foreign[0]]:
            frame.refuse(
                Reason.RESIDUAL,
                f"with a camera of its own its points fit {foreign[1]:.0f} times better than chance would have it "
                f"(usual below {FOREIGN:.0f}), and those of no other picture do: was it taken by another camera, "
                "or with another zoom, focus or crop?",
            )
        return True
    for frame, view in zip(kept, _views(kept), strict=True):
        angle = board_pose(view, chosen.camera).obliquity
        if angle > OBLIQUE:
            text = f"the board is seen {math.degrees(angle):.0f}° from square, allowed are 75°"
            frame.refuse(Reason.OBLIQUE, text)
    return len(used(kept)) < len(kept)


def rough_camera(frames: Sequence[RecordedFrame], given: CameraModel | None) -> Cameras:
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


def _views(frames: Sequence[RecordedFrame]) -> list[BoardView]:
    return [f.view for f in frames if f.view is not None]


def agreeing(frames: Sequence[RecordedFrame], camera: CameraModel) -> list[RecordedFrame]:
    """The used frames with a pose that agrees with those of the others; what does not is refused by name."""
    posed = [f for f in used(frames) if f.base_from_flange is not None]
    settle_orders(posed, camera)
    return refuse_misplaced(refuse_odd_ones(posed, camera), camera)


def solve_frames(
    frames: Sequence[RecordedFrame], cameras: Cameras, result: RecordedResult, *, setup: str = "eye_in_hand",
    given: CameraModel | None = None, hold_camera: bool = False,
) -> None:  # fmt: skip
    """Put camera, hand-eye, light plane and their checks into the result; a part that fails a check is refused.

    `cameras` are those of `camera_of`; `setup` says where the camera is. With `hold_camera` the arm has no say in
    the camera.
    """
    told = sum(f.base_from_flange is not None for f in used(frames))
    posed = agreeing(frames, cameras[0].camera)
    checks = _slips(told - len(posed), told) if posed else []
    if len(used(frames)) < len(cameras[0].view_rms):
        try:
            cameras = camera_of(frames, given)
        except RefusedError as error:
            result.notes.append(f"no intrinsics: {error}")
            return
        posed = [f for f in posed if f.reason is None]
    chosen, plain = cameras
    for frame, rms in zip(used(frames), chosen.view_rms, strict=True):
        frame.rms_px = math.sqrt(2) * float(rms)
    stops, views = _stops(frames, posed, result)
    if given is not None:
        chosen, beside = against_pictures(chosen, views)
        plain, checks = chosen, beside + checks
    result.intrinsics = result.intrinsics_from_pictures = pictures_figures(chosen)
    result.intrinsics_without_distortion = pictures_figures(plain)
    checks += camera_checks(chosen, views, [f.name for f in stops], given=given is not None)
    if posed:
        checks += _with_poses(posed, chosen, result, setup, hold_camera or given is not None)
    else:
        result.notes.append("no used frame has a flange pose: no hand-eye, no flatness")
    if result.light_plane is None and result.hand_eye is None:
        checks += plane_of_pictures(stops, chosen, result)
    result.apply(checks)


def _stops(
    frames: Sequence[RecordedFrame], posed: Sequence[RecordedFrame], result: RecordedResult
) -> tuple[list[RecordedFrame], list[BoardView]]:
    """The used frames, those of one stop as one, and their views; what people should know of these is noted."""
    rest = used(frames)
    stops = [merged(stop) for stop in by_stop(rest)]
    if len(stops) < len(rest):
        same = "pictures of one stop share its error and count as one frame, their mean"
        result.notes.append(f"{counted(len(rest), len(stops))}: {same}")
    if len(rest) > len(posed) > 0:
        more = len(rest) - len(posed)
        result.notes.append(f"{more} used frames have no flange pose: they count for the intrinsics only")
    return stops, _views(stops)


def _with_poses(
    posed: Sequence[RecordedFrame], camera: Intrinsics, result: RecordedResult, setup: str, hold_camera: bool
) -> list[QualityCheck]:
    """Put what frames with poses give into the result; its checks."""
    checks: list[QualityCheck] = []
    try:
        chain = solve_chain([merged(stop) for stop in by_stop(posed)], camera, setup, hold_camera)
        checks = check_chain(chain, camera)
        report_chain(chain, camera, result)
    except (RefusedError, np.linalg.LinAlgError) as error:
        result.refused["hand_eye"] = f"no hand-eye: {error}"
    return checks


def _slips(left_out: int, told: int) -> list[QualityCheck]:
    """Checks of frames that were left out for their pose: a few are slips."""
    if not left_out:
        return []
    name, text = "frames whose pose disagrees with the others", (
        f"{left_out} of {told} are left out for it, too many for slips: was the camera's zoom, focus or mount, or "
        "the place of the board or of the arm's base, changed in between? Then calibrate each part by itself"
    )  # fmt: skip
    share = 100 * left_out / told
    return [
        QualityCheck("hand_eye", name, share, doubt=25.0, refuse=40.0, unit="%", says=text),
        QualityCheck("intrinsics", name, share, doubt=25.0, refuse=math.inf, unit="%", says=text),
    ]


def note_perhaps_no_laser(frames: Sequence[RecordedFrame], result: RecordedResult) -> None:
    """Where few pictures show a line, and these are of no plane, there may be no laser: that is noted, not refused."""
    frames = used(frames)
    why, lit = result.refused.get("light_plane"), [f for f in frames if f.profile is not None]
    asked = any(f.stripe_from for f in lit)
    if why is None or asked or "intrinsics" in result.refused or len(lit) >= LIKELY_LASER * len(frames):
        return
    del result.refused["light_plane"]
    result.notes.append(
        f"no light plane: {len(lit)} of {len(frames)} pictures show a line that might be a laser's, and these lines "
        f"are of no light plane: {why}. Where there was a laser, name its colour with --laser"
    )
