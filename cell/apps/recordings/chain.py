"""The whole measuring chain from recorded frames with flange poses: camera, hand-eye, light plane and its flatness.

What is kept is what predicts frames that were left out best, and it is checked against figures that do not come from
the same fit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from cell.apps.recordings import result as form
from cell.apps.recordings.frames import RecordedFrame
from cell.apps.recordings.result import RecordedResult
from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.judge.checks import QualityCheck, hand_eye_checks
from cell.measure.calibration.judge.plane_checks import (
    PlaneKnown,
    crooked,
    flatness,
    leave_one_out,
    odd_stripes,
    plane_checks,
    planes_of_cameras,
    planes_without_one,
)
from cell.measure.calibration.judge.scale import Scale, metric_scale
from cell.measure.calibration.solve.adjustment import Adjustment
from cell.measure.calibration.solve.choice import Choice, choose_solution, with_doubt_of_camera
from cell.measure.calibration.solve.intrinsics import Intrinsics, moved_by_bend
from cell.measure.calibration.solve.joint import Staged, solve_staged
from cell.measure.calibration.solve.normal import CAMERA, HAND, OWN, SHARED, stripe_block
from cell.measure.calibration.solve.starts import PlaneStart, plane_from_board, stripe_means, stripe_pixels
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.stripe.profile import StripeProfile
from cell.measure.vision.stripe_on_board import on_plane
from drivers.errors import RefusedError

LEAST_FRAMES = 4
"""Of stops, not of pictures. With three poses everything fits: there is no fourth to disagree."""
STRIPE_MEANS = 120
Profiles = list[StripeProfile | None]


@dataclass(frozen=True, eq=False)
class StripesOnBoards:
    """The stripes of one light plane, its points (n, 3) in m on each board, and why others are left out, by place.
    `problem` says why there is no plane."""

    plane: PlaneStart | None
    profiles: Profiles
    clouds: list[Array]
    wrong: dict[int, str]
    problem: str = ""


def stripes_of_one_plane(
    camera: CameraModel, poses: Sequence[pin.SE3], frames: Sequence[RecordedFrame]
) -> StripesOnBoards:
    """The stripes on the frames' boards at poses (camera_from_board), those of another line of light left out."""
    views, profiles = [f.view for f in frames if f.view is not None], [f.profile for f in frames]
    if sum(profile is not None for profile in profiles) < 2:
        return StripesOnBoards(None, profiles, [], {}, "fewer than two frames show a laser stripe")
    wrong: dict[int, str] = {}
    while True:
        lit = [None if k in wrong else profile for k, profile in enumerate(profiles)]
        try:
            plane = plane_from_board(camera, poses, views, lit)
        except RefusedError as error:
            return StripesOnBoards(None, lit, [], wrong, str(error))
        clouds, bent = [], dict[int, str]()
        for k, (profile, rows, pose) in enumerate(zip(lit, plane.rows, poses, strict=True)):
            if profile is None or not len(rows):
                clouds.append(np.zeros((0, 3)))
                continue
            clouds.append(on_plane(camera, pose, stripe_pixels(profile, rows)))
            text = crooked(camera, *stripe_means(profile, rows, STRIPE_MEANS))
            if text is not None:
                bent[k] = text
        more = odd_stripes(clouds) | bent
        if not more:
            return StripesOnBoards(plane, lit, clouds, wrong)
        wrong |= more


@dataclass(frozen=True, eq=False)
class CalibrationChain:
    """What frames with poses give; `pictures` is the camera of the pictures, its deviation with what the arm says."""

    setup: str
    observations: list[ScanObservation]
    staged: Staged
    pictures: Intrinsics
    choice: Choice
    stripes: StripesOnBoards
    plane_known: PlaneKnown | None
    scale: Scale | None

    @property
    def noise(self) -> float:
        """What the stripe's own stated σ makes in m on the board, RMS."""
        best = self.choice.best
        flanges = best.adjusted.state.flanges or [v.base_from_flange for v in best.views]
        both = [both for both in zip(best.views, flanges, strict=True) if len(both[0].stripe)]
        parts = [stripe_block(best.adjusted.state, view, flange, 0.0)[2] for view, flange in both]
        return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def solve_chain(
    frames: Sequence[RecordedFrame], pictures: Intrinsics, setup: str, hold_camera: bool
) -> CalibrationChain:
    """Closed form and joint solution with the camera on the flange, or standing before it, as `setup` says. Raises
    RefusedError when there are too few frames, or they do not determine a hand-eye."""
    if len(frames) < LEAST_FRAMES:
        raise RefusedError(
            f"{len(frames)} stops have a flange pose; a hand-eye that can be checked needs {LEAST_FRAMES} or more "
            "(further pictures of one stop do not count)"
        )
    observations = [
        ScanObservation(f.view, f.profile, pose if setup == "eye_in_hand" else pose.inverse(), 0.0, f.name)
        for f in frames
        if (pose := f.base_from_flange) is not None
    ]
    staged = solve_staged(observations, stripe=False, camera=pictures.camera)
    scale = metric_scale([o.base_from_flange for o in observations], staged.camera_from_board)
    if scale is not None:
        # The boards' distances follow the focal length.
        scale = replace(scale, sigma=math.hypot(scale.sigma, float(pictures.sigma[0]) / pictures.camera.fx))
    stripes = stripes_of_one_plane(pictures.camera, staged.camera_from_board, frames)
    if stripes.plane is not None:
        seen = [replace(o, profile=profile) for o, profile in zip(observations, stripes.profiles, strict=True)]
        staged = solve_staged(seen, camera=pictures.camera)
    choice = choose_solution(observations, staged, pictures, camera_may_move=not hold_camera)
    choice, pictures = with_doubt_of_camera(choice, pictures)
    # What the shared parameters would move with a bent board or the arm's scale, where these are believed.
    best, unsure = choice.best, np.zeros(SHARED)
    if pictures.bend is not None and pictures.bend.believed:
        unsure = moved_by_bend(Adjustment(best.views, best.free, best.adjusted.priors), best.adjusted.state)
    if scale is not None:
        place = slice(HAND.start, HAND.start + 3)
        unsure[place] = np.hypot(unsure[place], scale.unsure * scale.shift)
    plane = _plane_known(choice, stripes, observations, pictures, unsure)
    if scale is not None and plane is not None:
        reach = float(np.median([np.linalg.norm(b.translation) for b in staged.camera_from_board]))
        plane = replace(plane, place=math.hypot(plane.place, scale.unsure * (scale.value - 1) * reach))
    best, closed = (replace(s, unsure=np.abs(unsure)) for s in (choice.best, choice.closed))
    choice = replace(choice, best=best, closed=closed)
    return CalibrationChain(
        setup, observations, staged, pictures=pictures, choice=choice, stripes=stripes, plane_known=plane, scale=scale
    )


def _plane_known(
    choice: Choice, stripes: StripesOnBoards, observations: Sequence[ScanObservation], pictures: Intrinsics,
    unsure: Array,
) -> PlaneKnown | None:  # fmt: skip
    """How well the light plane is known, None without one."""
    plane = choice.best.adjusted.state.plane
    if plane is None or stripes.plane is None:
        return None
    rows, cloud = stripes.plane.rows, np.concatenate(stripes.clouds)
    others = [p for k, r in enumerate(rows) if len(r) and (p := choice.best.left.states[k].plane) is not None]
    if choice.best.camera_free:
        other = choice.best.adjusted.state.moved(np.concatenate([unsure, np.zeros(OWN * len(observations))])).plane
        assert other is not None
        return PlaneKnown.of(plane, others, cloud, (plane, other))
    views = [o.view for o in observations if o.view is not None]
    moved = planes_of_cameras(pictures, views, [o.profile for o in observations], rows)
    return PlaneKnown.of(plane, others, cloud, moved)


def check_chain(chain: CalibrationChain, pictures: Intrinsics) -> list[QualityCheck]:
    """The absolute checks of hand-eye and light plane."""
    made = hand_eye_checks(chain.choice, chain.staged.camera_from_board, pictures)
    if chain.scale is not None:
        made.append(chain.scale.check(made))
    adjusted, staged, known = chain.choice.best.adjusted, chain.staged, chain.plane_known
    plane = adjusted.state.plane
    if plane is None or staged.plane is None or known is None:
        return made
    cloud = np.concatenate(chain.stripes.clouds)
    lit = sum(len(rows) > 0 for rows in staged.plane.rows)
    rms = max(staged.plane.rms, adjusted.stripe_rms_m)
    made += plane_checks(rms, chain.noise, cloud, frames=lit, known=known, left_out=len(chain.stripes.wrong))
    apart = math.degrees(math.acos(min(1.0, abs(float(plane.n @ staged.plane.plane.n)))))
    name, tilt = "plane with the arm against plane of the pictures", math.degrees(known.tilt)
    text = "the arm's poses and the board's in the pictures do not agree about it"
    made.append(QualityCheck("light_plane", name, apart, max(1.0, 4 * tilt), max(4.0, 8 * tilt), unit="deg", says=text))
    return made


def report_chain(chain: CalibrationChain, pictures: Intrinsics, result: RecordedResult) -> None:
    """Put camera, hand-eye, light plane, noise and flatness into the result."""
    choice, names, wrong = chain.choice, [o.name for o in chain.observations], chain.stripes.wrong
    best, staged = choice.best, chain.staged
    adjusted, state, sigma = best.adjusted, best.adjusted.state, best.sigma
    result.intrinsics = pictures_figures(chain.pictures)
    if best.camera_free:
        rms, held_out = math.sqrt(2) * adjusted.dots_rms_px, best.left.figures["dots_px"]
        figures = form.camera_figures(state.camera, sigma[CAMERA], rms, held_out, pictures.model.name)
        result.intrinsics = figures | {"method": best.name}
    closed = form.closed_form_figures(chain.setup, staged.hand_eye) | {"left_out": choice.closed.left.figures}
    hand_eye = form.hand_eye_figures(chain.setup, best.name, state.flange_from_camera, _scatter(chain), sigma[HAND])
    more = {"left_out": best.left.figures, "frames": len(names), "closed_form": closed}
    result.hand_eye = hand_eye | more
    # Variance components, with the camera of the pictures; the pictures' own scatter is in it.
    arm = {"arm_translation_mm": 1e3 * choice.arm[0], "arm_rotation_deg": math.degrees(choice.arm[1])}
    result.noise = {**arm, "chi2_per_dof": adjusted.chi2_per_dof}
    result.notes += form.setup_note(chain.setup, state.flange_from_camera)
    result.notes += [f"{names[k]}: {text} Its stripe is not used." for k, text in wrong.items()]
    if state.plane is None or staged.plane is None:
        result.notes.append(f"no light plane: {chain.stripes.problem}")
        return
    seen = [v.stripe for v in best.views if len(v.stripe)]
    rms, known = adjusted.stripe_rms_m, chain.plane_known
    result.light_plane = plane_figures(state.plane, rms, chain.noise, known, camera=state.camera, stripes=seen)
    result.light_plane["method"] = best.name
    left_out = form.flatness_figures(leave_one_out(chain.observations, staged, best), names)
    if (whole := form.flatness_figures(flatness(state, chain.observations, staged), names)) is not None:
        frame = "base" if chain.setup == "eye_in_hand" else "flange"
        result.flatness = {**whole, "frame": frame, "leave_one_out": left_out}


def _scatter(chain: CalibrationChain) -> tuple[float, float]:
    """RMS in m and rad by which the boards lie off one place in the base. Board and hand-eye belong to one camera: that
    which is reported."""
    state = chain.choice.best.adjusted.state
    boards = [
        o.base_from_flange * state.flange_from_camera * board_pose(o.view, state.camera).camera_from_board
        for o in chain.observations
        if o.view is not None
    ]
    apart = [b.translation - state.base_from_board.translation for b in boards]
    turns = [pin.log3(b.rotation @ state.base_from_board.rotation.T) for b in boards]
    way, turn = (float(np.sqrt(np.mean(np.sum(np.square(off), axis=1)))) for off in (apart, turns))
    return way, turn


def pictures_figures(found: Intrinsics) -> form.Figures:
    """A camera from pictures alone, px."""
    figures = form.camera_figures(
        found.camera, found.sigma, math.sqrt(2.0) * found.rms_px, found.held_out_px, found.model.name
    )
    return figures | {"method": "pictures alone"}


def plane_figures(
    plane: LightPlane, rms: float, noise: float, known: PlaneKnown | None, camera: CameraModel, stripes: Sequence[Array]
) -> form.Figures:
    """A light plane n·P = d in the camera frame. `rms` and the stripe's own `noise` in m, `stripes` (n, 2) in px."""
    depths = plane.intersect(camera.rays(np.concatenate(stripes)))[:, 2]
    return {
        "normal": plane.normal, "distance_mm": 1e3 * plane.distance, "rms_mm": 1e3 * rms,
        "depth_range_mm": [1e3 * float(np.nanmin(depths)), 1e3 * float(np.nanmax(depths))],
        "sigma_place_mm": None if known is None else 1e3 * known.place,
        "sigma_normal_deg": None if known is None else math.degrees(known.tilt), "stripe_noise_mm": 1e3 * noise,
    }  # fmt: skip


def plane_of_pictures(
    frames: Sequence[RecordedFrame], pictures: Intrinsics, result: RecordedResult
) -> list[QualityCheck]:
    """The light plane from pictures alone, when the stripe is in them, and its checks."""
    camera, views = pictures.camera, [f.view for f in frames if f.view is not None]
    poses = [board_pose(view, camera).camera_from_board for view in views]
    stripes = stripes_of_one_plane(camera, poses, frames)
    result.notes += [f"{frames[k].name}: {text} Its stripe is not used." for k, text in stripes.wrong.items()]
    plane = stripes.plane
    if plane is None:
        if sum(f.profile is not None for f in frames) < 2:
            result.notes.append(f"no light plane: {stripes.problem}")
        else:
            result.refused["light_plane"] = f"no light plane: {stripes.problem}"
        return []
    both = [(p, r) for p, r in zip(stripes.profiles, plane.rows, strict=True) if p is not None and len(r)]
    noise = [float(np.mean(stripe_means(p, r, STRIPE_MEANS)[1] ** 2)) for p, r in both]
    cloud: Array = np.concatenate(stripes.clouds)
    moved = planes_of_cameras(pictures, views, stripes.profiles, plane.rows)
    known = PlaneKnown.of(plane.plane, planes_without_one(stripes.clouds), cloud, moved)
    own = float(np.sqrt(np.mean(noise))) * float(np.median(cloud[:, 2])) / camera.fx
    seen = [stripe_pixels(p, r) for p, r in both]
    result.light_plane = plane_figures(plane.plane, plane.rms, own, known, camera=camera, stripes=seen)
    result.light_plane["method"] = "fit on the board's poses"
    return plane_checks(plane.rms, own, cloud, frames=len(both), known=known, left_out=len(stripes.wrong))
