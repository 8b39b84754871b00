"""The whole measuring chain from recorded frames with flange poses: camera, hand-eye, light plane and its flatness.

The camera may ride on the flange or stand before it, and nobody need say which. What is kept is what predicts frames
that were left out best, and it is checked against figures that do not come from the same fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.apps.recordings import result as form
from cell.apps.recordings.frames import RecordedFrame
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
)
from cell.measure.calibration.judge.scale import Scale, metric_scale
from cell.measure.calibration.solve.adjustment import Adjustment
from cell.measure.calibration.solve.choice import Choice, choose_solution, points_on_boards, with_doubt_of_camera
from cell.measure.calibration.solve.intrinsics import Intrinsics, moved_by_bend
from cell.measure.calibration.solve.joint import Staged, solve_staged, start_state
from cell.measure.calibration.solve.normal import CAMERA, HAND, OWN, PLANE, SHARED, stripe_block
from cell.measure.calibration.solve.starts import stripe_means
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.stripe.extract import StripeProfile
from drivers.errors import RefusedError

STRANGE_SHARE, STRANGE_TURN = 0.15, math.radians(10.0)
LEAST_FRAMES = 4
"""Of stops, not of pictures. With three poses everything fits: there is no fourth to disagree."""
STRIPE_MEANS = 120
Found = TypeVar("Found")


@dataclass(frozen=True, eq=False)
class CalibrationChain:
    """What frames with poses give. `stripes` says why a frame's stripe is not used, by the frame's place.

    `pictures` is the camera of the pictures, its deviation with what the arm says of it.
    """

    setup: str
    observations: list[ScanObservation]
    staged: Staged
    pictures: Intrinsics
    choice: Choice
    stripes: dict[int, str]
    no_plane: str
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
    frames: Sequence[RecordedFrame], pictures: Intrinsics, known: str | None = None, hold_camera: bool = False
) -> CalibrationChain:
    """Closed form and joint solution with the camera on the flange, or before it, whichever fits; `known` says which.

    Raises RefusedError when there are too few frames, or they do not determine a hand-eye.
    """
    if len(frames) < LEAST_FRAMES:
        raise RefusedError(
            f"{len(frames)} stops have a flange pose; a hand-eye that can be checked needs {LEAST_FRAMES} or more "
            "(further pictures of one stop do not count)"
        )
    setup, observations, staged = _placed(frames, pictures, known)
    reach = float(np.median([np.linalg.norm(b.translation) for b in staged.camera_from_board]))
    scale = metric_scale([o.base_from_flange for o in observations], staged.camera_from_board)
    if scale is not None:
        scale = scale.with_focal(float(pictures.sigma[0]) / pictures.camera.fx)
    _refuse_strangers(staged, scale, reach)
    staged, stripes, no_plane = _with_plane(observations, staged, pictures)
    choice = choose_solution(observations, staged, pictures, camera_may_move=not hold_camera)
    choice, pictures = with_doubt_of_camera(choice, pictures)
    # What the shared parameters (27,) would move with a bent board or the arm's scale, where these are believed.
    unsure, best = np.zeros(SHARED), choice.best
    if pictures.bend is not None and pictures.bend.believed:
        unsure = moved_by_bend(Adjustment(best.views, best.free, best.adjusted.priors), best.adjusted.state)
    if scale is not None and scale.believed:
        place = slice(HAND.start, HAND.start + 3)
        unsure[place] = np.hypot(unsure[place], scale.shift)
    plane = _plane_known(choice, staged, observations, pictures, unsure)
    if scale is not None and scale.believed and plane is not None:
        plane = replace(plane, place=math.hypot(plane.place, (scale.value - 1) * reach))
    best, closed = (replace(s, unsure=np.abs(unsure)) for s in (choice.best, choice.closed))
    choice = replace(choice, best=best, closed=closed)
    return CalibrationChain(
        setup,
        observations,
        staged,
        pictures=pictures,
        choice=choice,
        stripes=stripes,
        no_plane=no_plane,
        plane_known=plane,
        scale=scale,
    )


def _refuse_strangers(staged: Staged, scale: Scale | None, reach: float) -> None:
    """Refuse poses that have nothing to do with the pictures: no adjustment could make sense of them."""
    found = staged.hand_eye
    if found.scatter_m < STRANGE_SHARE * reach and found.scatter_rad < STRANGE_TURN:
        return
    text = (
        f"the poses and the pictures do not belong together: by the poses the board, which lies still, moves by "
        f"{1e3 * found.scatter_m:.0f} mm and {math.degrees(found.scatter_rad):.1f}° RMS (allowed "
        f"{100 * STRANGE_SHARE:.0f} % of its distance, {1e3 * STRANGE_SHARE * reach:.0f} mm, and "
        f"{math.degrees(STRANGE_TURN):.0f}°)"
    )
    if scale is not None and scale.unit is not None and found.scatter_rad < STRANGE_TURN:
        raise RefusedError(f"{text}; the flange's positions seem to be in {scale.unit}, not in m")
    raise RefusedError(
        f"{text}; are they of the same frames, in m, base_from_flange, and is the order of quaternions or angles right?"
    )


def _plane_known(
    choice: Choice, staged: Staged, observations: Sequence[ScanObservation], pictures: Intrinsics, unsure: Array
) -> PlaneKnown | None:
    """How well the light plane is known, None without one."""
    plane = choice.best.adjusted.state.plane
    if plane is None or staged.plane is None:
        return None
    lit = [k for k, rows in enumerate(staged.plane.rows) if len(rows)]
    others = [p for k in lit if (p := choice.best.left.states[k].plane) is not None]
    cloud = np.concatenate(points_on_boards(staged, observations))
    if choice.best.camera_free:
        other = choice.best.adjusted.state.moved(np.concatenate([unsure, np.zeros(OWN * len(observations))])).plane
        assert other is not None
        return PlaneKnown.of(plane, others, cloud, (plane, other))
    views = [o.view for o in observations if o.view is not None]
    moved = planes_of_cameras(pictures, views, [o.profile for o in observations], staged.plane.rows)
    return PlaneKnown.of(plane, others, cloud, moved)


def _placed(
    frames: Sequence[RecordedFrame], pictures: Intrinsics, known: str | None
) -> tuple[str, list[ScanObservation], Staged]:
    """Camera on the flange or before it, whichever leaves the board scattered less, without the stripe."""
    best: tuple[str, list[ScanObservation], Staged] | None = None
    for setup in ("eye_in_hand", "eye_to_hand") if known is None else (known,):
        told = [f.base_from_flange for f in frames if f.base_from_flange is not None]
        poses = told if setup == "eye_in_hand" else [pose.inverse() for pose in told]
        seen = [ScanObservation(f.view, f.profile, p, 0.0, f.name) for f, p in zip(frames, poses, strict=True)]
        staged = solve_staged(seen, stripe=False, camera=pictures.camera)
        if best is None or staged.hand_eye.scatter_m < 0.5 * best[2].hand_eye.scatter_m:
            best = setup, seen, staged
    assert best is not None
    return best


Profiles = Sequence[StripeProfile | None]
Rows = Sequence[NDArray[np.intp]]


def of_one_plane(
    profiles: Profiles,
    camera: CameraModel,
    fit: Callable[[Profiles], tuple[Found, Rows, Sequence[Array]]],
    wrong: dict[int, str],
) -> tuple[Found, Sequence[Array]]:
    """What `fit` finds of the stripes without those of another line, and its points on the boards.

    `fit` gives its result, the rows of each stripe that it used, and these points (n, 3) of each. `wrong` takes up why
    stripes are left out, by their place, also where it raises RefusedError.
    """
    while True:
        lit = [None if k in wrong else profile for k, profile in enumerate(profiles)]
        found, rows, clouds = fit(lit)
        more = odd_stripes(clouds)
        for k, (profile, some) in enumerate(zip(lit, rows, strict=True)):
            if profile is not None and len(some):
                text = crooked(camera, *stripe_means(profile, some, STRIPE_MEANS))
                if text is not None:
                    more[k] = text
        if not more:
            return found, clouds
        wrong |= more


def _with_plane(
    observations: list[ScanObservation], staged: Staged, pictures: Intrinsics
) -> tuple[Staged, dict[int, str], str]:
    """The closed form with its light plane, without stripes that are of another line; why, and why there is none."""
    profiles = [o.profile for o in observations]
    wrong: dict[int, str] = {}
    if sum(p is not None for p in profiles) < 2:
        return staged, wrong, "fewer than two frames show a laser stripe"

    def fit(lit: Profiles) -> tuple[Staged, Rows, Sequence[Array]]:
        seen = [replace(o, profile=p) for o, p in zip(observations, lit, strict=True)]
        found = solve_staged(seen, camera=pictures.camera)
        assert found.plane is not None
        return found, found.plane.rows, points_on_boards(found, seen)

    try:
        return of_one_plane(profiles, pictures.camera, fit, wrong)[0], wrong, ""
    except RefusedError as error:
        return staged, wrong, str(error)


def check_chain(chain: CalibrationChain, pictures: Intrinsics) -> list[QualityCheck]:
    """The absolute checks of hand-eye and light plane."""
    made = hand_eye_checks(chain.choice, chain.staged.camera_from_board, pictures)
    if chain.scale is not None:
        made.append(chain.scale.check(made))
    adjusted, staged, known = chain.choice.best.adjusted, chain.staged, chain.plane_known
    plane = adjusted.state.plane
    if plane is None or staged.plane is None or known is None:
        return made
    cloud = np.concatenate(points_on_boards(staged, chain.observations))
    lit = sum(len(rows) > 0 for rows in staged.plane.rows)
    rms = max(staged.plane.rms, adjusted.stripe_rms_m)
    made += plane_checks(rms, chain.noise, cloud, frames=lit, known=known, left_out=len(chain.stripes))
    apart = math.degrees(math.acos(min(1.0, abs(float(plane.n @ staged.plane.plane.n)))))
    name, tilt = "plane with the arm against plane of the pictures", math.degrees(known.tilt)
    text = "the arm's poses and the board's in the pictures do not agree about it"
    made.append(QualityCheck("light_plane", name, apart, max(1.0, 4 * tilt), max(4.0, 8 * tilt), unit="deg", says=text))
    return made


def report_chain(chain: CalibrationChain, pictures: Intrinsics, result: dict[str, Any]) -> None:
    """Put camera, hand-eye, light plane, noise and flatness into the result, lengths in mm."""
    best, choice, staged, names = chain.choice.best, chain.choice, chain.staged, [o.name for o in chain.observations]
    adjusted, state, sigma = best.adjusted, best.adjusted.state, best.sigma
    flat, flat_staged = (flatness(s, chain.observations, staged) for s in (state, start_state(staged)))
    left_out = leave_one_out(chain.observations, staged, best)
    # Board and hand-eye belong to one camera: that which is reported.
    boards = [
        o.base_from_flange * state.flange_from_camera * board_pose(o.view, state.camera).camera_from_board
        for o in chain.observations
        if o.view is not None
    ]
    apart = [b.translation - state.base_from_board.translation for b in boards]
    turns = [pin.log3(b.rotation @ state.base_from_board.rotation.T) for b in boards]
    scatter = [float(np.sqrt(np.mean(np.sum(np.square(off), axis=1)))) for off in (apart, turns)]
    result["intrinsics"] = form.intrinsics_dict(chain.pictures)
    if best.camera_free:
        result["intrinsics"] = {
            **form.camera_dict(state.camera, sigma[CAMERA]),
            "rms_px": math.sqrt(2) * adjusted.dots_rms_px,
            "held_out_rms_px": math.sqrt(2) * best.left.figures["dots_px"],
            "lens": pictures.model.name,
            "method": best.name,
        }
    result["hand_eye"] = {
        **form.hand_eye_dict(chain.setup, best.name, state.flange_from_camera, (scatter[0], scatter[1]), sigma[HAND]),
        "formal_sigma_mm": (1e3 * best.formal[HAND][:3]).tolist() if best.joint else None,
        "left_out": form.all_finite(best.left.figures),
        "frames": len(chain.observations),
        "closed_form": {
            **form.closed_form_dict(chain.setup, staged.hand_eye),
            "left_out": form.all_finite(choice.closed.left.figures),
        },
    }
    result["noise"] = {
        "arm_translation_mm": 1e3 * choice.arm[0],
        "arm_rotation_deg": math.degrees(choice.arm[1]),
        "arm_by": "variance components, with the camera of the pictures; the pictures' own scatter is in it",
        "arm_weight_mm": 1e3 * adjusted.priors.arm_translation if best.joint else None,
        "tried": [
            {"solution": s.name, "arm_weight_mm": 1e3 * s.adjusted.priors.arm_translation if s.joint else None}
            | {"left_out_mm": form.finite(s.figure()), **form.all_finite(s.left.figures)}
            for s in choice.tried
        ],
        "chi2_per_dof": form.finite(adjusted.chi2_per_dof),
    }
    result["notes"] += form.setup_note(chain.setup, state.flange_from_camera)
    result["notes"] += [f"{names[k]}: {text} Its stripe is not used." for k, text in chain.stripes.items()]
    if state.plane is None or staged.plane is None:
        result["notes"].append(f"no light plane: {chain.no_plane}")
        return
    depths = form.seen_depths(state.plane, state.camera, [v.stripe for v in best.views if len(v.stripe)])
    result["light_plane"] = {
        **form.plane_dict(best.name, state.plane, adjusted.stripe_rms_m, chain.noise, chain.plane_known, depths=depths),
        "sigma_distance_mm": 1e3 * float(sigma[PLANE][2]),
        "staged": form.normal_dict(staged.plane.plane, staged.plane.rms),
    }
    result["stripe_points"] = {n: len(r) for n, r in zip(names, staged.plane.rows, strict=True)}
    if (whole := form.flatness_dict(flat, names)) is not None:
        more = {"leave_one_out": form.flatness_dict(left_out, names), "staged": form.flatness_dict(flat_staged, names)}
        result["flatness"] = {**whole, "frame": "base" if chain.setup == "eye_in_hand" else "flange", **more}
