"""Triangles between the neighbours of an organised cloud, none across a depth edge; as PLY or STL."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.measure.reconstruction.cloud import Array, Indices

STEEPEST = np.cos(np.radians(80.0))
"""Triangles steeper than this against their sweep's mean normal lie between two surfaces, not on one."""
LONGEST = 3.0
"""Longest edge, in usual distances between lines."""


def triangles(points: Array, line: Indices, row: Indices, sweep: Indices) -> Indices:
    """Triangles (m, 3) of points (n, 3) that lie at (line, row) of their sweep; normals point to the camera.

    Each sweep is meshed by itself: where two overlap there are two sheets, as far apart as the seam says. Raises
    ValueError when no triangle can be made.
    """
    made = [_of_sweep(points, line, row, np.flatnonzero(sweep == k)) for k in np.unique(sweep)]
    faces = np.concatenate(made) if made else np.empty((0, 3), dtype=np.intp)
    if not len(faces):
        raise ValueError(f"{len(points)} points have no neighbours from which a mesh could be made")
    return faces


def _of_sweep(points: Array, line: Indices, row: Indices, mine: Indices) -> Indices:
    first = line[mine].min()
    grid = np.full((line[mine].max() - first + 1, row[mine].max() + 1), -1, dtype=np.intp)
    grid[line[mine] - first, row[mine]] = mine
    a, b, c, d = (g.ravel() for g in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    # Rows run along the image's y axis, lines along its x axis: this order turns towards the camera.
    faces = np.concatenate([np.column_stack([a, b, d]), np.column_stack([b, c, d])])
    faces = np.concatenate([faces, np.column_stack([a, b, c])[d < 0], np.column_stack([a, c, d])[b < 0]])
    faces = faces[(faces >= 0).all(axis=1)]
    if not len(faces):
        return faces
    corners = points[faces]
    edges = corners - np.roll(corners, 1, axis=1)
    lengths = np.linalg.norm(edges, axis=2).max(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mean = normals.sum(axis=0)
    size = np.linalg.norm(normals, axis=1) * np.linalg.norm(mean)
    good = (lengths < LONGEST * np.median(lengths)) & (normals @ mean > STEEPEST * size)
    return np.asarray(faces[good], dtype=np.intp)


def write_mesh(path: Path, points: Array, faces: Indices, colours: NDArray[np.uint8] | None = None) -> int:
    """Write the mesh in metres as PLY, or as binary STL (without colours) when `path` ends so; its triangles' number.

    Vertices that no triangle uses are left out.
    """
    import trimesh

    used, numbers = np.unique(faces, return_inverse=True)
    mesh = trimesh.Trimesh(
        points[used],
        numbers.reshape(faces.shape),
        vertex_colors=None if colours is None else colours[used],
        process=False,
    )
    mesh.export(path, file_type="stl" if path.suffix.lower() == ".stl" else "ply")
    return len(faces)
