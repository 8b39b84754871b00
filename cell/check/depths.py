"""From how far a calibration looks at its boards, for whoever needs no more of what a job must fit."""

CALIBRATION_DEPTHS = {"fine": (0.120, 0.130, 0.142), "large": (0.560, 0.650, 0.700)}
"""Nearest, usual and farthest distance of the calibration's views, m."""
