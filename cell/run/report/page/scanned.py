"""What a run has scanned, as its page shows it: points in mm and how far they lie off the drawn surface."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from cell.measure.geometry.poses import from_ur, transform
from cell.measure.inversion import NominalSurface
from cell.measure.reconstruction.ply import read_cloud
from cell.run.report.evidence import CLOUD
from drivers.errors import CellError
from drivers.interfaces import Vector


@dataclass(frozen=True, eq=False)
class Scanned:
    """Measured points (n, 3) in mm and their deviations (n,) in mm, NaN beside the surface.

    With deviations the points are in the surface's frame; without (None) they are about their middle, axes of the arm
    base, and `why` says what the deviations lack.
    """

    points: Vector
    deviation: Vector | None
    why: str


def scanned(folder: Path, report: Mapping[str, Any]) -> Scanned | None:
    """The cloud of a run, None where it has none; `CellError` for one that cannot be read."""
    if not (folder / CLOUD).exists():
        return None
    cloud = read_cloud(folder / CLOUD)
    points = cloud.points[~cloud.interpolated]
    try:
        base_from_surface, nominal = _surface(folder, report)
    except _NotKnown as error:
        middle = points.mean(axis=0) if len(points) else np.zeros(3)
        return Scanned(1e3 * (points - middle), None, str(error))
    local = transform(base_from_surface.inverse(), points)
    return Scanned(1e3 * local, 1e3 * nominal.deviations(local), "")


class _NotKnown(Exception):
    """Why a cloud cannot be compared with the drawn surface."""


def _surface(folder: Path, report: Mapping[str, Any]) -> tuple[pin.SE3, NominalSurface]:
    """The surface's pose that the run found, and the surface itself if its file is the one that the run had."""
    if (place := report.get("place_pose")) is None:
        raise _NotKnown("the run did not find the surface's place")
    try:
        job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
        part, unit = job["place"]["surface_from_part"], job["surface"]["mesh_unit"]
        surface_from_part = pin.SE3(pin.rpy.rpyToMatrix(*part["rotation"]), np.array(part["translation"]))
        file, told = Path(report["mesh"]["file"]), report["mesh"]["sha256"]
        if hashlib.sha256(file.read_bytes()).hexdigest() != told:
            raise _NotKnown(f"{file.name} was changed since the run: it is not the surface that was scanned for")
        nominal = NominalSurface.load(file, unit=unit)
    except (OSError, ValueError, KeyError, TypeError, CellError) as error:
        raise _NotKnown(f"the drawn surface cannot be read any more: {error}") from error
    values = np.array([*(1e-3 * v for v in place["translation_mm"]), *place["rotation_vector_rad"]])
    return from_ur(values) * surface_from_part.inverse(), nominal
