"""Is the hand-eye known, and do arm, board and pictures agree? Scatter, closed form against adjustment.

Absolute checks of the cell's own calibration: figures beside limits that its fit does not set itself.

Whether the residuals agree with each other is in its χ²; here is whether a plane is a plane, the lens a lens, and the
closed form about where the adjustment is."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cell.measure.calibration.judge.checks import QualityCheck
from cell.measure.calibration.judge.plane_checks import plane_fit_check
from cell.measure.calibration.solve.choice import Choice, Solution
from cell.measure.calibration.solve.intrinsics import Intrinsics
from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.normal import HAND, stripe_block
from cell.measure.geometry.camera import PARAMETER_NAMES, Array, CameraModel
from cell.measure.geometry.poses import difference

LEAST_FRAMES = 6
SHIFT_SHARE = 3.0
"""Percent of the distance to the board beyond which closed form and adjustment may not differ, whatever their σ."""


def hand_eye_checks(choice: Choice, boards: Sequence[pin.SE3], pictures: Intrinsics) -> list[QualityCheck]:
    """Checks of the solution that was chosen; `boards` are camera_from_board."""
    best = choice.best
    reach = float(np.median([np.linalg.norm(b.translation) for b in boards]))
    shift, turn = best.sigma[HAND][:3], best.sigma[HAND][3:]
    off = best.left.figures["board_mm"]
    arm_mm = 1e3 * choice.arm[0]
    count = len(boards)
    made = [
        QualityCheck(
            "hand_eye", "σ of its place", 100 * float(shift.max()) / reach, 1.0, 5.0, unit="% of the board's distance",
            says=f"{_mm(shift)} mm from {count} frames; turn the flange about two axes by 20° or more, to "
            "several sides",
        ),
        QualityCheck(
            "hand_eye", "σ of its turn", math.degrees(float(turn.max())), doubt=0.6, refuse=3.0, unit="deg",
            says=f"from {count} frames; turn the flange about two axes by 20° or more, to several sides",
        ),
        QualityCheck(
            "hand_eye", "board in left-out frames", 100 * off / 1e3 / reach, 1.0, refuse=5.0, unit="% of its distance",
            says=f"{off:.1f} mm from where the other frames put it at the reported poses: the arm scatters (about "
            f"{arm_mm:.2g} mm and {math.degrees(choice.arm[1]):.2g}° an axis), or poses and pictures do not belong "
            "together",
        ),
        QualityCheck(
            "hand_eye", "the arm's scatter", arm_mm, doubt=2.0, refuse=9.9, unit="mm",
            says=f"{math.degrees(choice.arm[1]):.2g}° beside it, by variance components with the camera of the "
            "pictures",
        ),
        QualityCheck(
            "hand_eye", "scatter of left-out solutions over the formal σ", _ratio(best), 3.0, refuse=math.inf, unit="",
            says="the residuals are not independent noise; the larger of both is stated",
        ),
        _closed_against(choice, reach),
    ]  # fmt: skip
    if count < LEAST_FRAMES:
        made.append(
            QualityCheck(
                "hand_eye", "frames that are missing", LEAST_FRAMES - count, doubt=0.5, refuse=math.inf, unit="",
                says=f"{count} frames check each other little; take {LEAST_FRAMES} or more",
            )
        )  # fmt: skip
    made += _camera_against(choice, pictures)
    return made


def _closed_against(choice: Choice, reach: float) -> QualityCheck:
    best, closed = choice.best, choice.closed
    a, b = best.adjusted.state.flange_from_camera, closed.adjusted.state.flange_from_camera
    apart = difference(a, b)
    # Both follow the camera and the frames in much the same way: the larger of both is what they may differ by.
    sigma = np.maximum(np.maximum(best.sigma[HAND], closed.sigma[HAND]), 1e-9)
    worst = float(np.max(np.abs(apart) / sigma)) if best.joint else 0.0
    far = 100 * float(np.linalg.norm(apart[:3])) / reach
    return QualityCheck(
        "hand_eye", "closed form against adjustment", worst, 3.0, 6.0 if far > SHIFT_SHARE else math.inf, unit="σ",
        says=f"{1e3 * float(np.linalg.norm(apart[:3])):.1f} mm and "
        f"{math.degrees(float(np.linalg.norm(apart[3:]))):.2f}° apart",
    )  # fmt: skip


def _camera_against(choice: Choice, pictures: Intrinsics) -> list[QualityCheck]:
    """The camera that the arm would have, against that of the pictures."""
    nearest = choice.with_arm
    if nearest is None or not pictures.sigma[:4].all():
        return []
    camera = nearest.adjusted.state.camera.parameters[:4]
    apart = np.abs(camera - pictures.camera.parameters[:4]) / pictures.sigma[:4]
    worst = int(np.argmax(apart))
    kept = "kept is that of the arm and the pictures" if choice.best.camera_free else "kept is that of the pictures"
    return [
        QualityCheck(
            "hand_eye", "camera with the arm against camera from the pictures", float(apart[worst]), doubt=3.0,
            refuse=math.inf, unit="σ",
            says=f"{PARAMETER_NAMES[worst]} would be {camera[worst]:.1f} px, by the pictures it is "
            f"{pictures.camera.parameters[worst]:.1f} ± {pictures.sigma[worst]:.1f} px; {kept}: the arm, the board's "
            "size or the lens is not what it is taken for",
        )
    ]  # fmt: skip


def _ratio(best: Solution) -> float:
    formal = np.maximum(best.formal[HAND], 1e-9)
    return float(np.max(best.scatter[HAND] / formal)) if best.joint else 0.0


def _mm(values: Array) -> str:
    return " × ".join(f"{1e3 * v:.1f}" for v in values)


def joint_checks(joint: Joint, nominal: CameraModel) -> list[QualityCheck]:
    """Checks of an adjustment against its closed form, the drawing's camera, its priors and its own noise."""
    adjusted, state = joint.adjusted, joint.adjusted.state
    reach = float(np.median([np.linalg.norm(b.translation) for b in joint.staged.camera_from_board]))
    apart = difference(state.flange_from_camera, joint.staged.hand_eye.flange_from_camera)
    shift, turn = 1e3 * float(np.linalg.norm(apart[:3])), math.degrees(float(np.linalg.norm(apart[3:])))
    focal = 100 * float(np.max(np.abs(state.camera.parameters[:2] / nominal.parameters[:2] - 1)))
    lens = np.abs(np.array(state.camera.dist)) / np.array(adjusted.priors.lens)
    worst = int(np.argmax(lens))
    excess = max(adjusted.excess.get("shift", 1.0), adjusted.excess.get("turn", 1.0))
    made = [
        QualityCheck(
            "hand_eye", "closed form against adjustment", shift / 10 / reach, doubt=2.0, refuse=8.0,
            unit="% of the board's distance",
            says=f"{shift:.2f} mm and {turn:.3f}° apart; see whether the views turn the flange about two axes",
        ),
        QualityCheck(
            "hand_eye", "the arm's scatter over what is configured", excess, doubt=4.0, refuse=9.9, unit="",
            says="the arm repeats worse than the configuration says, or something moved in between",
        ),
        QualityCheck(
            "intrinsics", "focal length against the drawing", focal, doubt=6.0, refuse=20.0, unit="%",
            says=f"{state.camera.fx:.0f} px, drawn {nominal.fx:.0f} px: is it the lens that the configuration names?",
        ),
        QualityCheck(
            "intrinsics", f"{PARAMETER_NAMES[4 + worst]} against what lenses have", float(lens[worst]), 3.0, math.inf,
            unit="σ", says=f"{state.camera.dist[worst]:.3g}: is it the lens that the configuration names?",
        ),
    ]  # fmt: skip
    parts, noise = [], []
    for view, flange, rail in zip(joint.views, state.flanges, state.rails.tolist(), strict=True):
        if len(view.stripe) and state.plane is not None:
            parts.append(state.plane.intersect(state.camera.rays(view.stripe)))
            noise.append(stripe_block(state, view, flange, rail)[2])
    if parts:
        own = float(np.sqrt(np.mean(np.concatenate(noise) ** 2)))
        made.append(plane_fit_check(adjusted.stripe_rms_m, own, np.concatenate(parts)))
    return made
