"""Whether a stored calibration can be one: figures, covariances and dates by themselves, and beside the configuration.

The digest of its file shows an edit; this shows what no calibration says, whoever wrote it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cell.base.storage import require_date
from cell.config.cell_config import CellConfig
from cell.measure.calibration.judge.faults import SCALE_RANGE
from cell.measure.geometry.camera import Array
from cell.measure.geometry.light_plane import LightPlane
from drivers.errors import CalibrationStale

if TYPE_CHECKING:
    from cell.config.calibrations.store import CellCalibration

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
    scan, target = calibration.scan, calibration.target
    for name, found in (("made", calibration), ("timing.made", scan.timing), ("confirmed.made", scan.confirmed)):
        if found is not None:
            require_date(name, found.made)
    for name, head in (("scan", scan), ("target", target)):
        camera, quality = head.camera, vars(head.quality)
        _require(f"{name}.camera, width and height in px", (camera.width, camera.height), 2, 1e5)
        _require(f"{name}.camera, parameters", camera.parameters, -1e6, 1e6)
        _require(f"{name}.camera, fx and fy over the width", camera.parameters[:2] / camera.width, 0.1, 100.0)
        off = camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5
        _require(f"{name}.camera, cx and cy from the middle, in widths and heights", off, -OUTSIDE, OUTSIDE)
        _require(f"{name}.flange_from_camera, m", head.flange_from_camera.translation, -2.0, 2.0)
        _require(f"{name}.quality", [figure for figure in quality.values() if figure is not None], 0.0, 1e9)
        if (kept := head.reference) is not None:
            require_covariance(f"{name}.reference.covariance", kept.covariance, range(len(kept.covariance)))
            _require(f"{name}.reference.base_from_board, m", kept.base_from_board.translation, -10.0, 10.0)
            sigma = kept.arm_translation, kept.arm_rotation, kept.rail, kept.dots_scale, kept.stripe_scale
            _require(f"{name}.reference, sigma and scale", sigma, 0.0, 1e3)
    require_covariance("scan.covariance", scan.covariance, LENS)
    require_covariance("target.hand_eye_covariance", target.hand_eye_covariance, range(0))
    _require("scan.light_plane, distance in m and bow", (scan.light_plane.distance, scan.light_plane.bow), -10.0, 10.0)
    _require("scan.light_plane.bow_sigma", scan.bow_sigma, 0.0, 10.0)
    _require("scan.light_plane.bow_gain", scan.bow_gain, -1e9, 1e9)
    _require("scan.rail_direction, its length", np.linalg.norm(scan.rail_direction), *SCALE_RANGE)
    if (witness := scan.witness) is not None:
        _require("scan.witness.rail, m", witness.rail, -10.0, 10.0)
        _require("scan.witness.sigma, px", witness.sigma[witness.rows], 1e-9, 1e3)


def require_covariance(name: str, covariance: Array, fixed: range) -> None:
    """Raise `ValueError` unless it is symmetric and positive definite; parameters of `fixed` may be zero throughout."""
    _require(name, covariance, -1e9, 1e9)
    variance = np.diag(covariance)
    zero = np.flatnonzero(variance == 0.0)
    if (variance < 0).any() or not set(zero.tolist()) <= set(fixed) or covariance[zero].any():
        raise ValueError(f"{name} has a variance of {variance.min():.3g}; all must be above 0")
    free = np.flatnonzero(variance)
    root = np.sqrt(variance[free])
    correlation = covariance[np.ix_(free, free)] / np.outer(root, root)
    if (off := np.abs(correlation - correlation.T).max(initial=0.0)) > SYMMETRIC or covariance[:, zero].any():
        raise ValueError(f"{name} is not symmetric: its correlations differ by {off:.2g}, allowed {SYMMETRIC:g}")
    least = np.linalg.eigvalsh(0.5 * (correlation + correlation.T)).min(initial=1.0)
    if not least > LEAST_EIGENVALUE:
        raise ValueError(f"{name} is not positive definite: an eigenvalue of its correlations is {least:.2g}")


def require_as_configured(calibration: CellCalibration, config: CellConfig) -> None:
    """Raise `CalibrationStale` where it is no calibration of the cell as drawn: a unit or a sign is wrong."""
    scan, laser = calibration.scan, config.laser
    try:
        for name, head, drawn in (
            ("scan", scan, config.scan_camera),
            ("target", calibration.target, config.target_camera),
        ):
            camera, focal = head.camera, drawn.focal_length / drawn.pixel
            _require(f"{name}.camera, width over the drawn one", camera.width / drawn.width, 1.0, 1.0)
            _require(f"{name}.camera, height over the drawn one", camera.height / drawn.height, 1.0, 1.0)
            _require(f"{name}.camera, fx and fy over the drawn ones", camera.parameters[:2] / focal, *FOCAL_RANGE)
            off = drawn.flange_from_camera.se3().actInv(head.flange_from_camera)
            _require(f"{name}.flange_from_camera against its drawing, m", off.translation, -MOUNT_M, MOUNT_M)
            _require(f"{name}.flange_from_camera against its drawing, rad", _angle(np.trace(off.rotation) / 2 - 0.5))
        plane = LightPlane.from_baseline(laser.baseline, float(np.arctan(laser.tan_theta)))
        # One plane has two normals.
        _require("scan.light_plane against its drawing, rad", _angle(abs(float(plane.n @ scan.light_plane.n))))
        off_plane = float(scan.light_plane.n @ laser.exit_point) - scan.light_plane.distance
        _require("scan.light_plane, the laser's exit off it, m", off_plane, -MOUNT_M, MOUNT_M)
        way = scan.rail_direction / np.linalg.norm(scan.rail_direction)
        _require("scan.rail_direction against the camera's x axis, rad", _angle(way[0]))
    except ValueError as error:
        raise CalibrationStale(
            f"the calibration of {calibration.date} does not fit the cell as configured: {error}; correct cell.toml, "
            "or run `cell calibrate`"
        ) from error


def _angle(cosine: float) -> float:
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _require(name: str, values: object, least: float = 0.0, most: float = MOUNT_RAD) -> None:
    """Written so that NaN is refused as well."""
    for value in np.ravel(np.asarray(values, dtype=np.float64)).tolist():
        if not least <= value <= most:
            raise ValueError(f"{name}: {value:.6g}, allowed {least:g} to {most:g}")
