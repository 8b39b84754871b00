"""How good a stored calibration is today."""
