"""Whether a sweep can see how the part lies once it was placed, as drawn."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cell.check.reach import seen_faces
from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.measure.inversion import Tolerance
from cell.measure.inversion.part_pose import shown_by
from drivers.errors import ConfigError


def verify_problems(job: Job, config: CellConfig) -> Iterator[str]:
    """What keeps a sweep from seeing the placed part; nothing where nobody looks."""
    try:
        faces = seen_faces(job)
    except ConfigError as error:
        yield str(error)
        return
    if faces is None or job.part is None:
        return
    name, (low, high) = Path(job.part.mesh).name, faces.extent
    half, camera, laser = 0.5 * float(high[2] - low[2]), config.scan_camera, config.laser
    nearest = job.scan.stand_off - half
    column = camera.focal_length / camera.pixel * (1 / laser.tan_theta - laser.baseline / max(nearest, 1e-3))
    if abs(column) > 0.5 * camera.width:
        yield (
            f'part.mesh "{name}": the faces of the placed part span {2e3 * half:.0f} mm of height; from scan.stand_off '
            f"{1e3 * job.scan.stand_off:g} mm the laser's line on the highest leaves the scan camera's picture. Raise "
            'scan.stand_off, or write place.verify = "none"'
        )
    tolerance = Tolerance(job.place.tolerance, job.place.tolerance_angle)
    if job.place.verify == "all" and (unseen := shown_by(faces, tolerance)):
        yield (
            f'part.mesh "{name}": the faces of the placed part do not show {", ".join(unseen)}. Write place.verify = '
            '"seen" to have the rest looked at, or "none"'
        )
