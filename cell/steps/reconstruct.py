"""Reconstruct: from the sweeps' profiles to the organised cloud in the arm base, written as PLY."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.calibration import ScanCalibration
from cell.reconstruction import (
    Cloud,
    Seam,
    calibration_motions,
    fill_holes,
    find_seams,
    flange_motions,
    merge,
    write_cloud,
)
from cell.reconstruction.seams import Motions
from cell.steps.laser_sweep import SweepRecord


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The cloud, how its sweeps agree where they overlap, and how its points move under each systematic error."""

    cloud: Cloud
    seams: tuple[Seam, ...]
    motions: Motions

    def summary(self) -> dict[str, object]:
        """Figures for the journal."""
        return {**self.cloud.summary(), "seams": [seam.as_dict() for seam in self.seams]}


def build_cloud(sweep: SweepRecord) -> Cloud:
    """The sweeps' points in the arm base, outliers removed: all that lies between the last frame and the cloud."""
    return merge([s.builder.place(s.lines, s.flanges, s.rail, s.line_spread) for s in sweep.swaths])


def reconstruct(sweep: SweepRecord, calibration: ScanCalibration, largest_hole: float, path: Path) -> Reconstruction:
    """Place every profile, remove outliers, interpolate holes up to `largest_hole` m and write the cloud to `path`.

    Raises `RefusedError` when too few points are left.
    """
    cloud = fill_holes(build_cloud(sweep).require(), largest_hole)
    motions = systematic(cloud, sweep, calibration)
    seams = tuple(find_seams(cloud, motions))
    write_cloud(path, cloud)
    return Reconstruction(cloud, seams, motions)


def systematic(cloud: Cloud, sweep: SweepRecord, calibration: ScanCalibration) -> Motions:
    """How one standard deviation of each independent parameter of the calibration, and of each sweep's flange pose,
    moves points of the cloud."""
    geometry, variants = calibration.geometry(), calibration.variants()
    covariances = [swath.covariance for swath in sweep.swaths]

    def motions(lines: np.ndarray, rows: np.ndarray) -> np.ndarray:
        by_calibration = calibration_motions(cloud, lines, rows, None, geometry, variants)
        return np.concatenate([by_calibration, flange_motions(cloud, lines, rows, covariances)], axis=2)

    return motions
