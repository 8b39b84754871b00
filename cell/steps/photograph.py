"""A photograph of the station's board, as its pose in the arm's base with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.calibration import TargetCalibration
from cell.geometry.poses import compose_covariance, from_ur, mean
from cell.job import PhotoSection
from cell.vision import BoardSpec, board_pose, find_board
from drivers.errors import RefusedError
from drivers.interfaces import Arm, Camera, Frame, Vector


@dataclass(frozen=True, eq=False)
class BoardFix:
    """The board in the arm's base; `covariance` (6, 6) in the base, translation then rotation, m and rad."""

    base_from_board: pin.SE3
    covariance: Vector
    residual_px: float
    obliquity: float
    frames: tuple[Frame, ...]

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            "residual_px": round(self.residual_px, 4),
            "obliquity_deg": round(math.degrees(self.obliquity), 2),
            "sigma_mm": [round(1e3 * s, 4) for s in sigma[:3]],
            "sigma_mrad": [round(1e3 * s, 4) for s in sigma[3:]],
        }


def photograph(
    arm: Arm,
    camera: Camera,
    calibration: TargetCalibration,
    spec: BoardSpec,
    limits: PhotoSection,
    repeatability: Vector,
    count: int = 1,
) -> BoardFix:
    """Photograph the board `count` times with arm and vehicle at rest and average its pose.

    `repeatability` is the (6, 6) covariance of base_from_flange. Raises `RefusedError` with the reason: board not
    found, seen more obliquely than `limits.max_obliquity`, residual above `limits.max_residual`, or pose ambiguous.
    """
    base_from_flange = from_ur(arm.state().flange)
    frames = tuple(camera.grab() for _ in range(count))
    poses = [board_pose(find_board(frame.image, spec), calibration.camera) for frame in frames]
    obliquity = max(pose.obliquity for pose in poses)
    if obliquity > limits.max_obliquity:
        raise RefusedError(
            f"the board is seen {math.degrees(obliquity):.1f} deg from square, allowed up to "
            f"{math.degrees(limits.max_obliquity):.0f} deg; photograph it from further in front"
        )
    residual = max(pose.rms_px for pose in poses)
    if residual > limits.max_residual:
        raise RefusedError(
            f"the board's dots miss their places by {residual:.2f} px RMS, allowed up to {limits.max_residual:.2f} px; "
            "is the target camera still in focus and calibrated, and the board flat?"
        )
    camera_from_board = mean([pose.camera_from_board for pose in poses])
    base_from_camera = base_from_flange * calibration.flange_from_camera
    hand_eye = compose_covariance(
        base_from_flange, repeatability, calibration.flange_from_camera, calibration.hand_eye_covariance
    )
    covariance = compose_covariance(
        base_from_camera, hand_eye, camera_from_board, np.mean([pose.covariance for pose in poses], axis=0) / count
    )
    return BoardFix(base_from_camera * camera_from_board, covariance, residual, obliquity, frames)
