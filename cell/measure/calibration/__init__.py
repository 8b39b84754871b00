"""Calibration of cameras, light plane, rail and hand-eye, from closed form to the joint adjustment."""

from cell.calibration.observations import ScanObservation, TargetObservation
from cell.calibration.solve.adjustment import Priors
from cell.calibration.solve.cameras import calibrate_scan, calibrate_target
from cell.calibration.solve.results import ScanCalibration, TargetCalibration

__all__ = [
    "Priors",
    "ScanCalibration",
    "ScanObservation",
    "TargetCalibration",
    "TargetObservation",
    "calibrate_scan",
    "calibrate_target",
]
