"""From stripe profiles to an organised cloud in the arm base."""

from cell.reconstruction.build import ProfileBuilder, ScanGeometry
from cell.reconstruction.cloud import Cloud
from cell.reconstruction.ply import deviation_colours, write_ply

__all__ = ["Cloud", "ProfileBuilder", "ScanGeometry", "deviation_colours", "write_ply"]
