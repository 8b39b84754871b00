"""What the sweep of a job looks for: the surface, or, where a part is to be unloaded, that part as it lies."""

from itertools import product
from pathlib import Path

import numpy as np
import pinocchio as pin

from cell.config.job import Job
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.part_pose import seen_from_above
from drivers.interfaces import Vector
from drivers.make import Pose


def sought(job: Job, mesh: Path) -> tuple[Job, Path]:
    """The job with what its sweep looks for as its surface, and the file of that mesh.

    To be unloaded, the part's upper side is the surface: it lies where `place.surface_from_part` has it, and is gripped
    where it is found. The scan head keeps its distance from it. Other jobs stay as they are.
    """
    lies = job.place.surface_from_part.se3()
    # A part that lies on one like it has the same mesh, and is not sought yet.
    if not job.unloads or job.part is None or (job.surface.mesh == job.part.mesh and lies == pin.SE3.Identity()):
        return job, mesh
    there = job.surface.place_from_surface.se3() * lies
    surface = job.surface.model_copy(
        update={"mesh": job.part.mesh, "mesh_unit": job.part.mesh_unit, "place_from_surface": pose_record(there)}
    )
    place = job.place.model_copy(update={"surface_from_part": pose_record(pin.SE3.Identity())})
    found, file = job.model_copy(update={"surface": surface, "place": place}), Path(job.part.mesh)
    low, high = nominal_of(found, file).extent
    above = job.scan.stand_off + 0.5 * float(low[2] + high[2])
    return found.model_copy(update={"scan": job.scan.model_copy(update={"stand_off": above})}), file


def nominal_of(job: Job, mesh: Path) -> NominalSurface:
    """The surface of a job as `sought` gives it, from its mesh's file. Raises `ConfigError`."""
    nominal = NominalSurface.load(mesh, unit=job.surface.mesh_unit)
    return seen_from_above(nominal, job.place.surface_from_part.se3()) if job.unloads else nominal


def ground_below(job: Job, extent: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
    """The box around the surface that a sought part lies on, lowest and highest corner (3,), m, part frame. `extent` is
    that of the surface in its own frame, of the job as it was read."""
    corners = np.array([[x, y, z] for x, y, z in product(*zip(*extent, strict=True))])
    found = transform(job.place.surface_from_part.se3().inverse(), corners)
    return found.min(axis=0), found.max(axis=0)


def around(box: tuple[Vector, Vector], other: tuple[Vector, Vector] | None) -> tuple[Vector, Vector]:
    """The box around both, as lowest and highest corner (3,)."""
    return box if other is None else (np.minimum(box[0], other[0]), np.maximum(box[1], other[1]))


def pose_record(pose: pin.SE3) -> Pose:
    """The pose as a job has it."""
    x, y, z = (float(v) for v in pose.translation)
    roll, pitch, yaw = (float(v) for v in pin.rpy.matrixToRpy(pose.rotation))
    return Pose.model_construct(translation=(x, y, z), rotation=(roll, pitch, yaw))
