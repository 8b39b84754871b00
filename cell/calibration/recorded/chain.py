"""The whole measuring chain from recorded frames with flange poses: camera, hand-eye, light plane and its flatness.

The camera may ride on the flange or stand before it, and nobody need say which. What is kept is what predicts frames
that were left out best, and it is checked against figures that do not come from the same fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from cell.calibration.observations import ScanObservation
from cell.calibration.recorded.folder import RecordedFrame
from cell.calibration.recorded.result import (
    camera_dict,
    closed_form_dict,
    finite_mm,
    flatness_dict,
    hand_eye_dict,
    intrinsics_dict,
    plane_dict,
    seen_depths,
    setup_note,
)
from cell.calibration.solve.adjustment import Adjustment
from cell.calibration.solve.blocks import CAMERA, HAND, OWN, PLANE, SHARED, stripe_block
from cell.calibration.solve.board_shape import moved_by_bend
from cell.calibration.solve.checks import Check
from cell.calibration.solve.choice import Choice, choose_solution, with_doubt_of_camera
from cell.calibration.solve.closed_form import points_on_boards
from cell.calibration.solve.flatness import Flatness, flatness, leave_one_out
from cell.calibration.solve.hand_eye_checks import hand_eye_checks
from cell.calibration.solve.intrinsics import Intrinsics
from cell.calibration.solve.joint import Staged, solve_staged, start_state
from cell.calibration.solve.plane_checks import PlaneKnown, crooked, odd_stripes, plane_checks, planes_of_cameras
from cell.calibration.solve.scale import Scale, metric_scale
from cell.calibration.solve.starts import stripe_means
from cell.geometry.camera import PARAMETER_NAMES, Array
from cell.vision.board.board import board_pose
from drivers.errors import RefusedError

Setup = str
STRANGE_SHARE, STRANGE_TURN = 0.15, math.radians(10.0)
LEAST_FRAMES = 4
"""Of stops, not of pictures. With three poses everything fits: there is no fourth to disagree."""


@dataclass(frozen=True, eq=False)
class Chain:
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
    flat_staged: Flatness | None
    flat: Flatness | None
    left_out: Flatness | None


def solve_chain(
    frames: Sequence[RecordedFrame], pictures: Intrinsics, known: Setup | None = None, hold_camera: bool = False
) -> Chain:
    """Closed form and joint solution with the camera on the flange, or before it, whichever fits; `known` says which.

    Raises RefusedError when there are too few frames, or they do not determine a hand-eye.
    """
    if len(frames) < LEAST_FRAMES:
        raise RefusedError(
            f"{len(frames)} stops have a flange pose; a hand-eye that can be checked needs {LEAST_FRAMES} or more "
            "(further pictures of one stop do not count)"
        )
    setup, observations, staged = _placed(frames, pictures, known)
    scale = metric_scale([o.base_from_flange for o in observations], staged.camera_from_board)
    if scale is not None:
        scale = scale.with_focal(float(pictures.sigma[0]) / pictures.camera.fx)
    _refuse_strangers(staged, scale)
    staged, stripes, no_plane = _with_plane(observations, staged, pictures)
    choice = choose_solution(observations, staged, pictures, camera_may_move=not hold_camera)
    choice, pictures = with_doubt_of_camera(choice, pictures)
    unsure = _unsure(choice, pictures, scale)
    known_plane = _plane_known(choice, staged, observations, pictures, unsure)
    best, closed = (replace(s, unsure=np.abs(unsure)) for s in (choice.best, choice.closed))
    choice = replace(choice, best=best, closed=closed)
    if scale is not None and scale.believed and known_plane is not None:
        reach = float(np.median([np.linalg.norm(b.translation) for b in staged.camera_from_board]))
        known_plane = replace(known_plane, place=math.hypot(known_plane.place, (scale.value - 1) * reach))
    return Chain(
        setup,
        observations,
        staged,
        pictures,
        choice,
        stripes,
        no_plane,
        known_plane,
        scale,
        flatness(start_state(staged), observations, staged),
        flatness(choice.best.adjusted.state, observations, staged),
        leave_one_out(observations, staged, choice.best),
    )


def _refuse_strangers(staged: Staged, scale: Scale | None) -> None:
    """Refuse poses that have nothing to do with the pictures: no adjustment could make sense of them."""
    found = staged.hand_eye
    reach = float(np.median([np.linalg.norm(b.translation) for b in staged.camera_from_board]))
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


def _unsure(choice: Choice, pictures: Intrinsics, scale: Scale | None) -> Array:
    """What the shared parameters (27,) would move with a bent board or the arm's scale, where these are believed."""
    unsure = np.zeros(SHARED)
    best = choice.best
    if pictures.bend is not None and pictures.bend.believed:
        adjustment = Adjustment(best.views, best.free, best.adjusted.priors)
        unsure = moved_by_bend(adjustment, best.adjusted.state)
    if scale is not None and scale.believed:
        place = slice(HAND.start, HAND.start + 3)
        unsure[place] = np.hypot(unsure[place], scale.shift)
    return unsure


def _plane_known(
    choice: Choice,
    staged: Staged,
    observations: Sequence[ScanObservation],
    pictures: Intrinsics,
    unsure: Array,
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
    frames: Sequence[RecordedFrame], pictures: Intrinsics, known: Setup | None
) -> tuple[str, list[ScanObservation], Staged]:
    """Camera on the flange or before it, whichever leaves the board scattered less, without the stripe."""
    best: tuple[float, str, list[ScanObservation], Staged] | None = None
    for setup in ("eye_in_hand", "eye_to_hand") if known is None else (known,):
        observations = [_observation(f, invert=setup == "eye_to_hand") for f in frames]
        staged = solve_staged(observations, stripe=False, camera=pictures.camera)
        if best is None or staged.hand_eye.scatter_m < 0.5 * best[0]:
            best = staged.hand_eye.scatter_m, setup, observations, staged
    assert best is not None
    return best[1:]


def _with_plane(
    observations: list[ScanObservation], staged: Staged, pictures: Intrinsics
) -> tuple[Staged, dict[int, str], str]:
    """The closed form with its light plane, without stripes that are of another line; why, and why there is none."""
    wrong: dict[int, str] = {}
    if sum(o.profile is not None for o in observations) < 2:
        return staged, wrong, "fewer than two frames show a laser stripe"
    while True:
        lit = [replace(o, profile=None) if k in wrong else o for k, o in enumerate(observations)]
        try:
            found = solve_staged(lit, camera=pictures.camera)
        except RefusedError as error:
            return staged, wrong, str(error)
        assert found.plane is not None
        more = odd_stripes(points_on_boards(found, lit))
        for k, (o, rows) in enumerate(zip(lit, found.plane.rows, strict=True)):
            if o.profile is not None and len(rows):
                text = crooked(pictures.camera, *stripe_means(o.profile, rows, 120))
                if text is not None:
                    more[k] = text
        if not more:
            return found, wrong, ""
        wrong |= more


def _observation(frame: RecordedFrame, invert: bool) -> ScanObservation:
    assert frame.base_from_flange is not None
    pose = frame.base_from_flange.inverse() if invert else frame.base_from_flange
    return ScanObservation(frame.view, frame.profile, pose, 0.0, frame.name)


def check_chain(chain: Chain, pictures: Intrinsics) -> list[Check]:
    """The absolute checks of hand-eye and light plane."""
    made = hand_eye_checks(chain.choice, chain.staged.camera_from_board, pictures)
    if chain.scale is not None:
        made.append(chain.scale.check(made))
    best, staged = chain.choice.best, chain.staged
    state = best.adjusted.state
    known = chain.plane_known
    if state.plane is None or staged.plane is None or known is None:
        return made
    cloud = np.concatenate(points_on_boards(staged, chain.observations))
    lit = [k for k, rows in enumerate(staged.plane.rows) if len(rows)]
    rms = max(staged.plane.rms, best.adjusted.stripe_rms_m)
    made += plane_checks(rms, _own_noise(chain), cloud, len(lit), known, len(chain.stripes))
    apart = math.degrees(math.acos(min(1.0, abs(float(state.plane.n @ staged.plane.plane.n)))))
    tilt = math.degrees(known.tilt)
    made.append(
        Check(
            "light_plane", "plane with the arm against plane of the pictures", apart, max(1.0, 4 * tilt),
            max(4.0, 8 * tilt), "deg", "the arm's poses and the board's in the pictures do not agree about it",
        )
    )  # fmt: skip
    return made


def _own_noise(chain: Chain) -> float:
    """What the stripe's own stated σ makes in m on the board, RMS."""
    state = chain.choice.best.adjusted.state
    flanges = state.flanges or [v.base_from_flange for v in chain.choice.best.views]
    parts = [
        stripe_block(state, view, flange, 0.0)[2]
        for view, flange in zip(chain.choice.best.views, flanges, strict=True)
        if len(view.stripe)
    ]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def report_chain(chain: Chain, pictures: Intrinsics, result: dict[str, Any]) -> None:
    """Put camera, hand-eye, light plane, noise and flatness into the result, lengths in mm."""
    best, choice = chain.choice.best, chain.choice
    adjusted, state, sigma = best.adjusted, best.adjusted.state, best.sigma
    # Board and hand-eye belong to one camera: that which is reported.
    boards = [
        o.base_from_flange * state.flange_from_camera * board_pose(o.view, state.camera).camera_from_board
        for o in chain.observations
        if o.view is not None
    ]
    apart = [b.translation - state.base_from_board.translation for b in boards]
    turns = [float(np.linalg.norm(pin.log3(b.rotation @ state.base_from_board.rotation.T))) for b in boards]
    if best.camera_free:
        result["intrinsics"] = {
            **camera_dict(state.camera),
            "rms_px": math.sqrt(2) * adjusted.dots_rms_px,
            "held_out_rms_px": math.sqrt(2) * best.left.figures["dots_px"],
            "sigma_px": dict(zip(PARAMETER_NAMES[:4], sigma[CAMERA][:4].tolist(), strict=True)),
            "lens": pictures.model.name,
            "method": best.name,
        }
    else:
        result["intrinsics"] = intrinsics_dict(chain.pictures)
    figures = {key: finite(value) for key, value in best.left.figures.items()}
    result["hand_eye"] = {
        "method": best.name,
        **hand_eye_dict(chain.setup, state.flange_from_camera),
        "scatter_mm": 1e3 * float(np.sqrt(np.mean(np.sum(np.square(apart), axis=1)))),
        "scatter_deg": math.degrees(float(np.sqrt(np.mean(np.square(turns))))),
        "sigma_mm": (1e3 * sigma[HAND][:3]).tolist(),
        "sigma_deg": np.degrees(sigma[HAND][3:]).tolist(),
        "formal_sigma_mm": (1e3 * best.formal[HAND][:3]).tolist() if best.joint else None,
        "left_out": figures,
        "frames": len(chain.observations),
        "closed_form": {
            **closed_form_dict(chain.setup, chain.staged.hand_eye),
            "left_out": {key: finite(value) for key, value in choice.closed.left.figures.items()},
        },
    }
    result["noise"] = {
        "arm_translation_mm": 1e3 * choice.arm[0],
        "arm_rotation_deg": math.degrees(choice.arm[1]),
        "arm_by": "variance components, with the camera of the pictures; the pictures' own scatter is in it",
        "arm_weight_mm": 1e3 * adjusted.priors.arm_translation if best.joint else None,
        "tried": [
            {"solution": s.name, "arm_weight_mm": 1e3 * s.adjusted.priors.arm_translation if s.joint else None}
            | {"left_out_mm": finite(s.figure()), **{k: finite(v) for k, v in s.left.figures.items()}}
            for s in choice.tried
        ],
        "chi2_per_dof": finite(adjusted.chi2_per_dof),
    }
    result["notes"] += setup_note(chain.setup, state.flange_from_camera)
    _report_plane(chain, result)


def _report_plane(chain: Chain, result: dict[str, Any]) -> None:
    best, staged = chain.choice.best, chain.staged
    state, names = best.adjusted.state, [o.name for o in chain.observations]
    result["notes"] += [f"{names[k]}: {text} Its stripe is not used." for k, text in chain.stripes.items()]
    if state.plane is None or staged.plane is None:
        result["notes"].append(f"no light plane: {chain.no_plane}")
        return
    known = chain.plane_known
    result["light_plane"] = {
        **plane_dict(state.plane),
        "rms_mm": 1e3 * best.adjusted.stripe_rms_m,
        "depth_range_mm": seen_depths(state.plane, state.camera, [v.stripe for v in best.views if len(v.stripe)]),
        "sigma_distance_mm": 1e3 * float(best.sigma[PLANE][2]),
        "sigma_place_mm": None if known is None else 1e3 * known.place,
        "sigma_normal_deg": None if known is None else math.degrees(known.tilt),
        "stripe_noise_mm": 1e3 * _own_noise(chain),
        "method": best.name,
        "staged": {
            **plane_dict(staged.plane.plane),
            "rms_mm": 1e3 * staged.plane.rms,
            "cross_ratio_check_mm": None if staged.paper is None else finite_mm(staged.paper.cross_ratio_m),
        },
    }
    result["stripe_points"] = {n: len(r) for n, r in zip(names, staged.plane.rows, strict=True)}
    if chain.flat is not None:
        result["flatness"] = {
            **flatness_dict(chain.flat, names),
            "frame": "base" if chain.setup == "eye_in_hand" else "flange",
            "leave_one_out": None if chain.left_out is None else flatness_dict(chain.left_out, names),
            "staged": None if chain.flat_staged is None else flatness_dict(chain.flat_staged, names),
        }


def finite(value: float) -> float | None:
    """None for what is not known."""
    return value if math.isfinite(value) else None
