"""A finished run's cloud in the formats of other programs, coloured by its deviation from the nominal surface."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.config.job import load_job
from cell.measure.geometry.poses import from_ur, transform
from cell.measure.reconstruction.ply import StoredCloud, deviation_colours, read_cloud, triangles, write_mesh, write_ply
from cell.procedures.sought_part import nominal_of, sought
from cell.run.folder import Report, read_report
from cell.run.report.figures import simulated_words
from cell.run.resumption import job_hash
from drivers.errors import ConfigError

SUFFIXES = {"ply": ".ply", "stl": ".stl", "mesh": ".ply"}
"""Of each format; "mesh" is a coloured mesh, "ply" a coloured cloud."""


def export_run(folder: Path, kind: str, out: Path, job: str | None, limit: float) -> dict[str, Any]:
    """Write the cloud of the run in `folder` to `out`; what was written, JSON-ready.

    `kind` is one of `SUFFIXES`. With a place pose in the report the points are coloured by their distance from the
    nominal surface of `job` (the run's own, unless given), the colours' ends at ±`limit` m. Raises `ConfigError` when
    the run has no cloud or the job is not found.
    """
    if not (folder / "cloud.ply").is_file():
        raise ConfigError(f"run {folder.name} has no cloud: it ended before `reconstruct`; `cell runs` lists others")
    cloud = read_cloud(folder / "cloud.ply")
    report = read_report(folder)
    deviations = _deviations(cloud, report, job)
    colours = None if deviations is None else deviation_colours(deviations, limit)
    written: dict[str, object] = {"run": folder.name, "format": kind, "file": str(out), "points": len(cloud.points)}
    if kind == "ply":
        scalars: dict[str, NDArray[np.generic]] = {
            "sigma": cloud.sigma.astype(np.float32),
            "interpolated": cloud.interpolated.astype(np.uint8),
        }
        write_ply(
            out, cloud.points, quality=deviations, colours=colours, scalars=scalars,
            comment=_comment(deviations, report),
        )  # fmt: skip
    else:
        try:
            faces = triangles(cloud.points, cloud.line, cloud.row, cloud.sweep)
        except ValueError as error:
            raise ConfigError(f"run {folder.name}: {error}") from error
        written["triangles"] = write_mesh(out, cloud.points, faces, colours)
    if deviations is not None:
        known = 1e3 * deviations[np.isfinite(deviations) & ~cloud.interpolated]
        if len(known):
            written["deviation_mm"] = {
                "points": len(known), "mean": float(known.mean()), "rms": float(np.sqrt(np.mean(known**2))),
                "p95": float(np.percentile(np.abs(known), 95)),
            }  # fmt: skip
    return written


def _comment(deviations: NDArray[np.float64] | None, report: Report) -> str:
    lines = ["frame: arm base", simulated_words(report.get("simulated"))]
    lines += [] if deviations is None else ["quality: distance from the nominal surface in metres"]
    return "\n".join(line for line in lines if line)


def _deviations(cloud: StoredCloud, report: Report, name: str | None) -> NDArray[np.float64] | None:
    """Signed distances (n,) in m from the nominal surface where the run found it; None without a place pose."""
    pose = report.get("place_pose")
    if pose is None:
        return None
    try:
        file = name or report.get("job_file", report["job"])
        if name is None and job_hash(file) != report.get("job_hash"):
            raise ConfigError(f"{file} or a mesh of it was changed since the run")
        job, mesh = sought(*load_job(file))
    except (ConfigError, OSError) as error:
        raise ConfigError(f"{error}; name the run's job file with --job") from error
    values = np.array([*(1e-3 * v for v in pose["translation_mm"]), *pose["rotation_vector_rad"]])
    base_from_surface = from_ur(values) * job.place.surface_from_part.se3().inverse()
    return nominal_of(job, mesh).deviations(transform(base_from_surface.inverse(), cloud.points))
