"""A photograph of the station's board, as its pose in the arm's base with its covariance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from cell.config.job import PhotoSection
from cell.measure.calibration import TargetCalibration
from cell.measure.geometry.poses import compose_covariance, from_ur, mean, transform
from cell.measure.vision import BoardPose, BoardSpec, BoardView, board_pose, find_board
from cell.procedures.drive.settled import swing
from drivers.errors import Measured, RefusedError
from drivers.interfaces import Arm, Camera, Frame, Vector


@dataclass(frozen=True, eq=False)
class BoardFix:
    """The board in the arm's base; `covariance` (6, 6) in the base, translation then rotation, m and rad.

    `views` are the points found in each of the `frames`; by ±`swung` m the board moved between them, 0 where that does
    not show. `notes` are for people. `flange` (6,) is what the arm told meanwhile; `number` counts a run's photographs.
    """

    base_from_board: pin.SE3
    covariance: Vector
    residual_px: float
    obliquity: float
    frames: tuple[Frame, ...]
    views: tuple[BoardView, ...] = ()
    swung: float = 0.0
    notes: tuple[str, ...] = ()
    flange: Vector = field(default_factory=lambda: np.zeros(6))
    number: int = 0
    by_mount: Vector = field(default_factory=lambda: np.zeros((6, 6)))

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            "residual_px": round(self.residual_px, 4),
            "obliquity_deg": round(math.degrees(self.obliquity), 2),
            "sigma_mm": [round(1e3 * s, 4) for s in sigma[:3]],
            "sigma_mrad": [round(1e3 * s, 4) for s in sigma[3:]],
            "swung_mm": round(1e3 * self.swung, 4),
        }


def photograph(
    arm: Arm,
    camera: Camera,
    calibration: TargetCalibration,
    spec: BoardSpec,
    limits: PhotoSection,
    repeatability: Vector,
    count: int = 1,
    keep: Callable[[Frame], None] = lambda frame: None,
    pause: Callable[[], None] = lambda: None,
) -> BoardFix:
    """Photograph the board `count` times with arm and vehicle at rest and average its pose.

    `repeatability` is the (6, 6) covariance of base_from_flange; `keep` is given each frame before it is looked at;
    `pause` is called between two.
    Raises `RefusedError` with the reason: board not found, seen more obliquely than `limits.max_obliquity`, residual
    above `limits.max_residual`, or pose ambiguous; it shows the "frame" and the "view", as far as there is one.
    """
    flange = arm.state().flange
    base_from_flange = from_ur(flange)
    frames: list[Frame] = []
    for k in range(count):
        if k:
            pause()
        frames.append(camera.grab())
        keep(frames[-1])
    views: list[BoardView] = []
    poses: list[BoardPose] = []
    for frame in frames:
        view = None
        try:
            view = find_board(frame.image, spec)
            pose = board_pose(view, calibration.camera)
            _require(pose, limits)
        except RefusedError as refused:
            refused.showing(seen={"frame": frame, "view": view})
            raise
        views.append(view)
        poses.append(pose)
    obliquity = max(pose.obliquity for pose in poses)
    residual = max(pose.rms_px for pose in poses)
    camera_from_board = mean([pose.camera_from_board for pose in poses])
    base_from_camera = base_from_flange * calibration.flange_from_camera
    hand_eye = compose_covariance(
        base_from_flange, repeatability, calibration.flange_from_camera, calibration.hand_eye_covariance
    )
    covariance = compose_covariance(
        base_from_camera, hand_eye, camera_from_board, np.mean([pose.covariance for pose in poses], axis=0) / count
    )
    mount = compose_covariance(
        base_from_flange, nothing := np.zeros((6, 6)), calibration.flange_from_camera, calibration.hand_eye_covariance
    )
    by_mount = compose_covariance(base_from_camera, mount, camera_from_board, nothing)
    centre = transform(camera_from_board, views[0].object_points.mean(axis=0)[None])[0]
    swung = swing(views, float(centre[2]) / calibration.camera.fx)
    seen = base_from_camera * camera_from_board, covariance, residual, obliquity
    return BoardFix(*seen, tuple(frames), tuple(views), swung, flange=flange, by_mount=by_mount)


def _require(pose: BoardPose, limits: PhotoSection) -> None:
    if not pose.obliquity <= limits.max_obliquity:
        seen, allowed = math.degrees(pose.obliquity), math.degrees(limits.max_obliquity)
        raise RefusedError(
            f"the board is seen {seen:.1f} deg from square, allowed up to {allowed:.0f} deg; photograph it from "
            "further in front",
            Measured("board, from square", seen, "deg", most=allowed),
        )
    if not pose.rms_px <= limits.max_residual:
        raise RefusedError(
            f"the board's dots miss their places by {pose.rms_px:.3g} px RMS, allowed up to {limits.max_residual:.3g} "
            "px; is the target camera still in focus and calibrated, and the board flat?",
            Measured("board's dots off their places, RMS", pose.rms_px, "px", most=limits.max_residual),
        )
