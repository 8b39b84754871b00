"""Calibration of cameras, light plane, rail and hand-eye, from closed form to the joint adjustment."""

from cell.measure.calibration.archive import ScanObservation, TargetObservation
from cell.measure.calibration.solve.adjustment import Priors
from cell.measure.calibration.solve.results import ScanCalibration, TargetCalibration

__all__ = ["Priors", "ScanCalibration", "ScanObservation", "TargetCalibration", "TargetObservation"]
