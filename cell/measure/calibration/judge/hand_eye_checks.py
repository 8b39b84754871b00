"""Is the hand-eye known, and do arm, board and pictures agree? Scatter, closed form against adjustment."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from cell.measure.calibration.judge.checks import QualityCheck
from cell.measure.calibration.solve.blocks import HAND
from cell.measure.calibration.solve.choice import Choice, Solution
from cell.measure.calibration.solve.intrinsics import Intrinsics
from cell.measure.geometry.camera import PARAMETER_NAMES, Array
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
