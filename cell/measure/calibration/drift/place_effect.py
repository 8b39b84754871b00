"""What a change of the calibration would do to the place, in m: of the points of a scan, and of the board's place."""

from __future__ import annotations

import numpy as np

from cell.measure.calibration.solve.blocks import SHARED, AdjustmentState
from cell.measure.calibration.solve.results import ScanCalibration, TargetCalibration
from cell.measure.geometry.camera import Array
from cell.measure.reconstruction.build import ScanGeometry

DEPTHS = (-0.01, 0.0, 0.01)
ROWS = 9


def scan_effect(scan: ScanCalibration, change: Array, stand_off: float, rail: tuple[float, float]) -> float:
    """RMS in m of how far a change (27,) of the calibration moves the points of a sweep, in the flange's frame.

    Over the picture's rows, depths of ± 10 mm about `stand_off` m in front of the camera, and the rail from end to end.
    """
    state = AdjustmentState(
        scan.camera, scan.light_plane, scan.rail_direction, scan.flange_from_camera, scan.flange_from_camera
    )  # fmt: skip
    moved = state.moved(np.asarray(change, dtype=np.float64)[:SHARED])
    assert moved.plane is not None
    n, d = scan.light_plane.n, scan.light_plane.distance
    pixels = []
    for depth in DEPTHS:
        z = stand_off + depth
        y = np.linspace(-0.4, 0.4, ROWS) * scan.camera.height / scan.camera.fy * z
        x = (d - n[1] * y - n[2] * z) / n[0]
        pixels.append(scan.camera.project(np.column_stack([x, y, np.full(ROWS, z)])))
    seen = np.concatenate(pixels)
    after = ScanGeometry(moved.camera, moved.plane, moved.rail_direction, moved.flange_from_camera)
    squares = [
        np.sum((after.solve(seen, at)[0] - scan.geometry().solve(seen, at)[0]) ** 2, axis=1)
        for at in (np.full(len(seen), position) for position in rail)
    ]
    return float(np.sqrt(np.nanmean(squares)))


def target_effect(target: TargetCalibration, change: Array, camera_from_place: Array) -> float:
    """How far in m a change (27,) of the calibration moves a place that lies at (3,) m in the target camera's frame."""
    state = AdjustmentState(target.camera, None, np.zeros(3), target.flange_from_camera, target.flange_from_camera)
    moved = state.moved(np.asarray(change, dtype=np.float64)[:SHARED])
    before, after = target.camera, moved.camera
    # The same picture through the other lens: a shift of the principal point turns the rays, a focal length stretches
    # the distance.
    seen = np.array(camera_from_place, dtype=np.float64)
    turned = seen + seen[2] * np.array([
        -(after.cx - before.cx) / before.fx, -(after.cy - before.cy) / before.fy, 0.5 * (
            (after.fx - before.fx) / before.fx + (after.fy - before.fy) / before.fy
        ),
    ])  # fmt: skip
    was = target.flange_from_camera.act(seen)
    return float(np.linalg.norm(moved.flange_from_camera.act(turned) - was))
