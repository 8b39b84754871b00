"""Calibration of cameras, light plane, rail and hand-eye, from closed form to the joint adjustment."""

from cell.measure.calibration.observations import ScanObservation, TargetObservation
from cell.measure.calibration.solve.adjustment import Priors
from cell.measure.calibration.solve.cameras import calibrate_scan, calibrate_target
from cell.measure.calibration.solve.results import ScanCalibration, TargetCalibration

__all__ = [
    "Priors",
    "ScanCalibration",
    "ScanObservation",
    "TargetCalibration",
    "TargetObservation",
    "calibrate_scan",
    "calibrate_target",
]
