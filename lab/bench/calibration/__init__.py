"""Calibration and its verification beside their bounds."""
