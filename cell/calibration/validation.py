"""Whether a stored calibration can be one: figures, covariances and dates by themselves, and beside the configuration.

The digest of its file shows an edit; this shows what no calibration says, whoever wrote it.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from cell.calibration.solve.faults import SCALE_RANGE
from cell.calibration.solve.results import ScanCalibration, TargetCalibration
from cell.config import CellConfig
from cell.geometry.camera import Array, CameraModel
from cell.geometry.light_plane import LightPlane
from drivers.errors import CalibrationStale

if TYPE_CHECKING:
    from cell.calibration.store import CellCalibration
    from cell.device_config import CameraConfig

CLOCK_SLACK_S = 3600.0
"""How far a date may lie in the future: clocks of two machines differ."""
FIRST_S = 978_307_200.0
"""2001-01-01: nothing was calibrated before."""
LENS = range(4, 9)
"""Parameters of a lens that a calibration may leave as they are; all others it must have estimated."""
LEAST_EIGENVALUE, SYMMETRIC = 1e-10, 1e-5
"""Of the correlations: solved ones have eigenvalues above 1e-5, and differ across the diagonal by less than 1e-6."""
FOCAL_RANGE, OUTSIDE = (0.8, 1.25), 0.25
"""A focal length over the drawn one; how far from the middle the principal point may lie, in widths and heights."""
MOUNT_M, MOUNT_RAD = 0.05, float(np.deg2rad(15.0))
"""How far mounts, the rail's way and the light plane may be from their drawing: ten times what mounting leaves."""


def require_valid(calibration: CellCalibration) -> None:
    """Raise `ValueError` with the value and its allowed range where the figures by themselves cannot be."""
    require_date("made", calibration.made)
    scan, target = calibration.scan, calibration.target
    for name, found in (("scan.timing", scan.timing), ("scan.confirmed", scan.confirmed)):
        if found is not None:
            require_date(f"{name}.made", found.made)
    for name, head in (("scan", scan), ("target", target)):
        _require_camera(f"{name}.camera", head.camera)
        pose = head.flange_from_camera.homogeneous
        _require(f"{name}.flange_from_camera, m", np.abs(pose[:3, 3]).max(), 0.0, 2.0)
        quality = head.quality
        _require(f"{name}.quality.views", quality.views, 1, 1e6)
        for key in ("chi2_per_dof", "dots_rms_px", "stripe_rms", "held_out_px", "held_out_stripe"):
            if (figure := getattr(quality, key)) is not None:
                _require(f"{name}.quality.{key}", figure, 0.0, 1e9)
        if (kept := head.reference) is not None:
            require_covariance(f"{name}.reference.covariance", kept.covariance, range(len(kept.covariance)))
            _require(f"{name}.reference.base_from_board, m", np.abs(kept.base_from_board.translation).max(), 0.0, 10.0)
            for key in ("arm_translation", "arm_rotation", "rail", "dots_scale", "stripe_scale"):
                _require(f"{name}.reference, {key}", getattr(kept, key), 0.0, 1e3)
    require_covariance("scan.covariance", scan.covariance, LENS)
    require_covariance("target.hand_eye_covariance", target.hand_eye_covariance, range(0))
    plane = scan.light_plane
    _require("scan.light_plane.distance, m", plane.distance, -1.0, 1.0)
    _require("scan.light_plane.bow", plane.bow, -10.0, 10.0)
    _require("scan.light_plane.bow_sigma", scan.bow_sigma, 0.0, 10.0)
    _require("scan.light_plane.bow_gain", np.abs(scan.bow_gain).max(), 0.0, 1e9)
    _require("scan.rail_direction, its length", float(np.linalg.norm(scan.rail_direction)), *SCALE_RANGE)
    if (witness := scan.witness) is not None:
        rows = witness.rows
        _require("scan.witness.rail, m", witness.rail, -10.0, 10.0)
        _require("scan.witness.columns, px", np.abs(witness.columns[rows]).max(initial=0.0), 0.0, 1e5)
        _require("scan.witness.sigma, px", witness.sigma[rows].min(initial=1.0), 1e-9, 1e3)


def require_date(name: str, seconds: float) -> None:
    """Raise `ValueError` where a date, seconds since the epoch, is none or lies in the future."""
    if not FIRST_S <= seconds < float("inf"):
        raise ValueError(f"{name} is {seconds}, no date in seconds since 1970 (from {FIRST_S:.0f}, 2001-01-01)")
    if (ahead := seconds - time.time()) > CLOCK_SLACK_S:
        raise ValueError(
            f"{name} lies {ahead / 3600:.1f} hours in the future, so its age is not known (allowed: "
            f"{CLOCK_SLACK_S / 3600:g} h); set this machine's clock"
        )


def require_covariance(name: str, covariance: Array, fixed: range) -> None:
    """Raise `ValueError` unless it is symmetric and positive definite; parameters of `fixed` may be zero throughout."""
    if not np.isfinite(covariance).all():
        raise ValueError(f"{name} holds values that are no numbers")
    variance = np.diag(covariance)
    zero = np.flatnonzero(variance == 0.0)
    if (
        (variance < 0).any()
        or not set(zero.tolist()) <= set(fixed)
        or covariance[zero].any()
        or covariance[:, zero].any()
    ):
        raise ValueError(f"{name} has a variance of {variance.min():.3g}; all must be above 0")
    free = np.flatnonzero(variance)
    root = np.sqrt(variance[free])
    correlation = covariance[np.ix_(free, free)] / np.outer(root, root)
    if (off := np.abs(correlation - correlation.T).max(initial=0.0)) > SYMMETRIC:
        raise ValueError(f"{name} is not symmetric: its correlations differ by {off:.2g}, allowed {SYMMETRIC:g}")
    least = np.linalg.eigvalsh(0.5 * (correlation + correlation.T)).min(initial=1.0)
    if not least > LEAST_EIGENVALUE:
        raise ValueError(
            f"{name} is not positive definite: the least eigenvalue of its correlations is {least:.2g}, allowed is "
            f"more than {LEAST_EIGENVALUE:g}"
        )


def require_as_configured(calibration: CellCalibration, config: CellConfig) -> None:
    """Raise `CalibrationStale` where it is no calibration of the cell as drawn: a unit or a sign is wrong."""
    scan = calibration.scan
    try:
        _require_drawn("scan", scan, config.scan_camera)
        _require_drawn("target", calibration.target, config.target_camera)
        drawn = LightPlane.from_baseline(config.laser.baseline, float(np.arctan(config.laser.tan_theta)))
        # One plane has two normals.
        along = abs(float(drawn.n @ scan.light_plane.n))
        _require("scan.light_plane.normal against its drawing, rad", np.arccos(min(1.0, along)), 0.0, MOUNT_RAD)
        off = abs(float(scan.light_plane.n @ config.laser.exit_point) - scan.light_plane.distance)
        _require("scan.light_plane, the laser's exit off it, m", off, 0.0, MOUNT_M)
        cosine = scan.rail_direction[0] / np.linalg.norm(scan.rail_direction)
        _require(
            "scan.rail_direction against the camera's x axis, rad", np.arccos(np.clip(cosine, -1, 1)), 0.0, MOUNT_RAD
        )
    except ValueError as error:
        raise CalibrationStale(
            f"the calibration of {calibration.date} does not fit the cell as configured: {error}; correct cell.toml, "
            "or run `cell calibrate`"
        ) from error


def _require_drawn(name: str, head: ScanCalibration | TargetCalibration, drawn: CameraConfig) -> None:
    camera, focal = head.camera, drawn.focal_length / drawn.pixel
    if (camera.width, camera.height) != (drawn.width, drawn.height):
        raise ValueError(f"{name}.camera has {camera.width}×{camera.height} px, drawn are {drawn.width}×{drawn.height}")
    _require(f"{name}.camera, fx over the drawn one", camera.fx / focal, *FOCAL_RANGE)
    _require(f"{name}.camera, fy over the drawn one", camera.fy / focal, *FOCAL_RANGE)
    off = drawn.flange_from_camera.se3().actInv(head.flange_from_camera)
    _require(f"{name}.flange_from_camera against its drawing, m", float(np.linalg.norm(off.translation)), 0.0, MOUNT_M)
    turn = np.arccos(np.clip(0.5 * (np.trace(off.rotation) - 1.0), -1.0, 1.0))
    _require(f"{name}.flange_from_camera against its drawing, rad", turn, 0.0, MOUNT_RAD)


def _require_camera(name: str, camera: CameraModel) -> None:
    if not np.isfinite(camera.parameters).all():
        raise ValueError(f"{name} holds values that are no numbers")
    for key, centre, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        _require(f"{name}, the picture's size in px", size, 2, 100_000)
        _require(f"{name}, {key} from the middle, in widths or heights", abs(centre / size - 0.5), 0.0, OUTSIDE)
    for key, focal in (("fx", camera.fx), ("fy", camera.fy)):
        _require(f"{name}, {key} over the width", focal / camera.width, 0.1, 100.0)


def _require(name: str, value: float, least: float, most: float) -> None:
    """Written so that NaN is refused as well."""
    if not least <= value <= most:
        raise ValueError(f"{name}: {value:.6g}, allowed {least:g} to {most:g}")
