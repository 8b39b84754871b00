"""Parts whose underside is the surface that they are placed onto: a body of 20 mm above it, drawn in the part frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from cell.config.job import job_path, load_job
from cell.measure.inversion.nominal import read_mesh

Floats = NDArray[np.float64]
HEIGHT = 0.020


def body(vertices: Floats, faces: NDArray[np.int64], changed: Callable[[Floats], Floats]) -> trimesh.Trimesh:
    """A closed body on the surface; `changed` gives the underside's corners (n, 3), m, as they are drawn instead."""
    top = vertices * [1.0, 1.0, 0.0] + [0.0, 0.0, vertices[:, 2].max() + HEIGHT]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    a, b = edges[first[count == 1]].T
    n = len(vertices)
    sides = np.concatenate([np.stack([a, b, b + n], 1), np.stack([a, b + n, a + n], 1)])
    return trimesh.Trimesh(
        np.concatenate([changed(vertices), top]), np.concatenate([faces[:, ::-1], faces + n, sides]), process=False
    )


def job_with_part(folder: Path, name: str, changed: Callable[[Floats], Floats] = lambda corners: corners) -> Path:
    """A shipped job in `folder`, with a mesh of its part beside it: what `load_job` reads."""
    job, mesh = load_job(name)
    assert np.allclose(job.place.surface_from_part.se3().homogeneous, np.eye(4))
    body(*read_mesh(mesh, job.surface.mesh_unit), changed).export(folder / f"{name}-part.ply")
    (folder / f"{name}.ply").write_bytes(mesh.read_bytes())
    text = job_path(name).read_text(encoding="utf-8")
    path = folder / f"{name}.toml"
    path.write_text(f'{text}\n[part]\nmesh = "{name}-part.ply"\nmesh_unit = "m"\n', encoding="utf-8")
    return path
