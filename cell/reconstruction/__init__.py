"""From stripe profiles to an organised cloud in the arm base."""

from cell.reconstruction.build import ProfileBuilder, ScanGeometry
from cell.reconstruction.cloud import Cloud
from cell.reconstruction.ply import deviation_colours, write_ply
from cell.reconstruction.sensitivity import calibration_motions

__all__ = ["Cloud", "ProfileBuilder", "ScanGeometry", "calibration_motions", "deviation_colours", "write_ply"]
