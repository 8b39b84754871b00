"""The file of a surface: its triangles in metres, or what is wrong with it.

By itself, so that whoever only looks at the mesh does not bring along everything that inverts with it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import ConfigError

Array = NDArray[np.float64]


def read_mesh(path: Path, unit: str) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (n, 3) in m and triangles (m, 3) of a mesh file in `unit`, "m" or "mm".

    Raises `ConfigError` when it is no mesh, or none of a size that a part can be placed onto.
    """
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=True)
        vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:  # every reader of trimesh raises its own
        raise ConfigError(f"nominal surface {path} cannot be read as a mesh; give an STL or PLY") from error
    if vertices.ndim != 2 or not len(faces) or not np.isfinite(vertices).all():
        raise ConfigError(
            f"nominal surface {path} holds {len(faces)} triangles, or corners that are not numbers; give an STL or PLY "
            "of the surface"
        )
    vertices *= 1.0 if unit == "m" else 1e-3
    extent = float(np.ptp(vertices, axis=0).max())
    if not 0.001 < extent < 5.0:
        raise ConfigError(
            f"nominal surface {path} measures {1e3 * extent:.3g} mm with mesh_unit = {unit!r} (allowed: 1 to 5000 mm); "
            "check surface.mesh_unit in the job"
        )
    return vertices, faces
