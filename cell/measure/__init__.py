"""From arrays to estimates with their covariance: vision, reconstruction, inversion, calibration.

Knows no device and no run.
"""
