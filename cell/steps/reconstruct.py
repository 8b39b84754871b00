"""Reconstruct: from the sweep's profiles to the organised cloud in the arm base, written as PLY."""

from __future__ import annotations

from pathlib import Path

from cell.calibration import ScanCalibration
from cell.reconstruction import Cloud, ProfileBuilder, write_ply
from cell.steps.laser_sweep import SweepRecord


def reconstruct(sweep: SweepRecord, calibration: ScanCalibration, rail_sigma: float, path: Path) -> Cloud:
    """Triangulate every profile, remove outliers and write the cloud to `path`.

    `rail_sigma` is the standard deviation in m of one profile's rail position. Raises `RefusedError` when too few
    points are left.
    """
    builder = ProfileBuilder(calibration.geometry(), len(sweep.profiles))
    for profile, position in zip(sweep.profiles, sweep.positions, strict=True):
        builder.add(profile, float(position), rail_sigma)
    cloud = builder.finish(sweep.base_from_flange)
    lines, rows = cloud.valid.nonzero()
    write_ply(path, cloud.points[lines, rows])
    return cloud
