"""Collecting what a calibration is solved from."""
