"""From stripe profiles to an organised cloud in the arm base."""

from cell.reconstruction.build import ProfileBuilder, ScanGeometry
from cell.reconstruction.cloud import Cloud, Filled, merge
from cell.reconstruction.holes import fill_holes
from cell.reconstruction.ply import deviation_colours, write_cloud, write_ply
from cell.reconstruction.seams import Seam, find_seams
from cell.reconstruction.sensitivity import calibration_motions, flange_motions, lean_motions

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
