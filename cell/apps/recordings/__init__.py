"""Calibration from frames that were recorded elsewhere."""
