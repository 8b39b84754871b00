"""Jobs whose part is drawn on the surface that it is placed onto: a shell of 20 mm above it, in the part frame."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import tomlkit
import trimesh
from numpy.typing import NDArray

from cell.config.job import job_path, load_job
from cell.measure.inversion.nominal import read_mesh

Floats = NDArray[np.float64]
Faces = NDArray[np.int64]
HEIGHT = 0.020
ALL = (1.0, 1.0)
MIDDLE = (0.022, 1.0)
"""Half the sides, m, of a part that leaves 13 mm of the surface of `pot` to be seen at both ends."""


def body(
    vertices: Floats, faces: Faces, changed: Callable[[Floats], Floats] = lambda corners: corners, *, flat: bool = False
) -> trimesh.Trimesh:
    """A closed body on the surface; `changed` gives the underside's corners (n, 3), m, as they are drawn instead. Its
    top is that of a shell, or `flat`."""
    top = vertices + np.array([0.0, 0.0, HEIGHT])
    if flat:
        top[:, 2] = top[:, 2].max()
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    a, b = edges[first[count == 1]].T
    n = len(vertices)
    sides = np.concatenate([np.stack([a, b, b + n], 1), np.stack([a, b + n, a + n], 1)])
    return trimesh.Trimesh(
        np.concatenate([changed(vertices), top]), np.concatenate([faces[:, ::-1], faces + n, sides]), process=False
    )


def within(vertices: Floats, faces: Faces, half: tuple[float, float]) -> tuple[Floats, Faces]:
    """What of a surface lies within |x| and |y| ≤ `half`, m: the rest shows beside a part on it."""
    inside = (np.abs(vertices[faces][..., :2]) <= half).all(axis=(1, 2))
    used, again = np.unique(faces[inside], return_inverse=True)
    return vertices[used], again.reshape(-1, 3)


def job_with_part(
    folder: Path, name: str, changed: Callable[[Floats], Floats] = lambda corners: corners, *, verify: str = "none",
    half: tuple[float, float] = ALL, flat: bool = False, also: str = "corrections = 0",
) -> Path:  # fmt: skip
    """A shipped job in `folder`, with a mesh of its part beside it: what `load_job` reads. `also` is of its [place].
    Raises `ConfigError` for a name that does not ship."""
    job, mesh = load_job(name)
    assert np.allclose(job.place.surface_from_part.se3().homogeneous, np.eye(4))
    surface = within(*read_mesh(mesh, job.surface.mesh_unit), half)
    body(*surface, changed, flat=flat).export(folder / f"{name}-part.ply")
    (folder / mesh.name).write_bytes(mesh.read_bytes())
    described = tomlkit.parse(job_path(name).read_text(encoding="utf-8"))
    described["place"].update({"verify": verify, **tomlkit.parse(also)})
    described["part"] = {"mesh": f"{name}-part.ply", "mesh_unit": "m"}
    path = folder / f"{name}.toml"
    path.write_text(tomlkit.dumps(described), encoding="utf-8")
    return path
