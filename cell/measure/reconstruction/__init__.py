"""From stripe profiles to an organised cloud in the arm base."""

from cell.measure.reconstruction.build import (
    ProfileBuilder,
    ScanGeometry,
    calibration_motions,
    flange_motions,
    lean_motions,
)
from cell.measure.reconstruction.cloud import Cloud, Filled, Seam, find_seams, merge
from cell.measure.reconstruction.holes import fill_holes
from cell.measure.reconstruction.ply import deviation_colours, write_cloud, write_ply

__all__ = [
    "Cloud",
    "Filled",
    "ProfileBuilder",
    "ScanGeometry",
    "Seam",
    "calibration_motions",
    "deviation_colours",
    "fill_holes",
    "find_seams",
    "flange_motions",
    "lean_motions",
    "merge",
    "write_cloud",
    "write_ply",
]
