"""Absolute checks of the cell's own calibration: figures beside limits that its fit does not set itself.

Whether the residuals agree with each other is in its χ²; here is whether a plane is a plane, the lens a lens, and the
closed form about where the adjustment is.
"""

from __future__ import annotations

import math

import numpy as np

from cell.measure.calibration.judge.checks import QualityCheck
from cell.measure.calibration.judge.plane_checks import plane_fit_check
from cell.measure.calibration.solve.blocks import stripe_block
from cell.measure.calibration.solve.joint import Joint
from cell.measure.geometry.camera import PARAMETER_NAMES, CameraModel
from cell.measure.geometry.poses import difference


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
