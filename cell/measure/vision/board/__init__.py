"""Calibration boards in pictures: found, identified, measured, or refused."""
