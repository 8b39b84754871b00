"""Pictures of the links: a folder of meshes that the 3-D scene shows in place of the planner's capsules.

They are for the eye only; the planner keeps apart what it kept apart before.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.base.toml_file import below
from drivers.errors import ConfigError

LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
"""Fixed to the base, then to what each joint turns."""
NAMES = (*LINKS, "flange", "vehicle")
KINDS = (".stl", ".ply", ".obj")
MOST_TRIANGLES = 8_000
"""A finer mesh is drawn coarser."""
SMALLEST_M, LARGEST_M = 0.005, 5.0


def link_meshes(folder: Path) -> list[dict[str, Any]]:
    """The files of `folder` as JSON objects: `on`, one of `NAMES`, flat `vertices` in m and `triangles`.

    Raises `ConfigError` for a folder that is not there, a file of another name, two of one name, and one that is no
    mesh in metres.
    """
    try:
        files = sorted(path for path in folder.iterdir() if below(folder, path.name) and not path.name.startswith("."))
    except OSError as error:
        raise ConfigError(
            f"cell.meshes: the folder {folder} cannot be read ({error.strerror}); create it or remove the line"
        ) from error
    found: dict[str, Path] = {}
    for path in files:
        if path.suffix.lower() not in KINDS:
            continue
        if path.stem not in NAMES:
            raise ConfigError(
                f"cell.meshes: {path} belongs to no link; the names are {', '.join(NAMES)} with {', '.join(KINDS)}"
            )
        if path.stem in found:
            raise ConfigError(
                f"cell.meshes: {path.name} and {found[path.stem].name} in {folder} are the same link; keep one"
            )
        found[path.stem] = path
    if not found:
        raise ConfigError(
            f"cell.meshes: {folder} holds no mesh; the names are {', '.join(NAMES)} with {', '.join(KINDS)}"
        )
    return [_drawn(name, path) for name, path in found.items()]


def _drawn(name: str, path: Path) -> dict[str, Any]:
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=True)
        vertices, triangles = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    except Exception as error:  # every reader of trimesh raises its own
        raise ConfigError(f"cell.meshes: {path} cannot be read as a mesh; export it as STL, PLY or OBJ") from error
    if vertices.ndim != 2 or not len(triangles) or not np.isfinite(vertices).all():
        raise ConfigError(
            f"cell.meshes: {path} holds {len(triangles)} triangles, or corners that are not numbers; export it again"
        )
    size = float(np.ptp(vertices, axis=0).max())
    if not SMALLEST_M <= size <= LARGEST_M:
        raise ConfigError(
            f"cell.meshes: {path} measures {size:.3g} m (allowed: {SMALLEST_M:g} to {LARGEST_M:g} m); export it in "
            "metres"
        )
    points, faces = coarser(vertices, triangles)
    return {"on": name, "vertices": points.round(5).ravel().tolist(), "triangles": faces.ravel().tolist()}


def coarser(
    vertices: NDArray[np.float64], triangles: NDArray[np.int64], most: int = MOST_TRIANGLES
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The mesh of vertices (n, 3) m and triangles (m, 3), or one of at most `most`: one vertex for all in a cube."""
    edge = float(np.ptp(vertices, axis=0).max()) / 512
    points, faces = vertices, triangles
    while len(faces) > most:
        cubes = np.floor((vertices - vertices.min(axis=0)) / edge).astype(np.int64)
        _, owner = np.unique(cubes @ np.array([1, 1 << 20, 1 << 40]), return_inverse=True)
        count = np.bincount(owner)
        points = np.column_stack([np.bincount(owner, weights=vertices[:, axis]) / count for axis in range(3)])
        faces = owner[triangles]
        apart = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces, edge = faces[apart], 1.5 * edge
    return points, faces
