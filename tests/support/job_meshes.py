"""Draws the meshes of the shipped jobs: few triangles, whose heights fit the closed form best.

`pip install fast-simplification && python -m tests.support.job_meshes` writes `cell/jobs/*.ply` anew. Triangles are
long where the surface bends in one direction only, so that the seat's edges stay sharp. Corners on the surface would
put every facet of a dome below it. Heights of least squares leave facets on both sides: a place pose sees their mean.
"""

from importlib.resources import files
from pathlib import Path

import numpy as np
import scipy
import trimesh
from numpy.typing import NDArray

from sim_backends.world.bodies.surfaces import Surface, SurfaceMesh, mesh, surface

Floats = NDArray[np.float64]
Faces = NDArray[np.int32]

TRIANGLES = {"pot": 7600, "seat": 6800, "panel": 8200}
"""Of each mesh, 13 bytes each: together 300 kB. They share the error out evenly."""
FINE = 320_000
"""Triangles of the regular mesh that is decimated."""
AGGRESSION = 5
"""Of the decimation: with more it merges corners in a worse order."""
DIVISIONS = 8
"""Of a triangle's side; the fit sums over the squared number of points."""
FOLDER = Path(str(files("cell").joinpath("jobs")))


def draw(name: str) -> SurfaceMesh:
    """The mesh of the surface `name`, m, frame S, over its whole footprint."""
    fine, field = mesh(name, FINE, walls=False), surface(name)
    coarse = trimesh.Trimesh(1e3 * fine.vertices, fine.triangles).simplify_quadric_decimation(
        face_count=TRIANGLES[name], aggression=AGGRESSION
    )
    vertices, triangles = 1e-3 * np.array(coarse.vertices), np.array(coarse.faces, dtype=np.int32)
    _fill_footprint(vertices, triangles, np.array([field.half_x, field.half_y]))
    _fit_heights(vertices, triangles, field)
    return SurfaceMesh(vertices, triangles)


def _fill_footprint(vertices: Floats, triangles: Faces, half: Floats) -> None:
    """Bring the border's corners to the footprint's sides, and the nearest ones to its corners: decimation cuts them
    off."""
    edges, count = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0, return_counts=True)
    border = np.unique(edges[count == 1])
    side = np.argmin(half - np.abs(vertices[border, :2]), axis=1)
    vertices[border, side] = np.sign(vertices[border, side]) * half[side]
    for corner in half * [[-1, -1], [-1, 1], [1, -1], [1, 1]]:
        nearest = border[np.argmin(np.linalg.norm(vertices[border, :2] - corner, axis=1))]
        vertices[nearest, :2] = corner


def _fit_heights(vertices: Floats, triangles: Faces, field: Surface) -> None:
    """Set z so that the integral of the squared normal distance from the closed form is least."""
    # Points in the middle of the small triangles into which each is divided, by their weights of its corners.
    i, j = np.nonzero(np.add.outer(np.arange(DIVISIONS), np.arange(DIVISIONS)) < DIVISIONS)
    upper = i + j < DIVISIONS - 1
    first = np.concatenate([i + 1 / 3, i[upper] + 2 / 3]) / DIVISIONS
    second = np.concatenate([j + 1 / 3, j[upper] + 2 / 3]) / DIVISIONS
    weights = np.column_stack([first, second, 1.0 - first - second])
    corners = vertices[triangles][:, :, :2]
    # A hair beyond the border lies the table.
    heights, normals = field.sample(*(0.999999 * np.einsum("pk,tkc->tpc", weights, corners).reshape(-1, 2)).T)
    areas = np.repeat(np.linalg.det(corners[:, 1:] - corners[:, :1]), len(weights))
    columns, rows = np.repeat(triangles, len(weights), axis=0).ravel(), np.repeat(np.arange(len(heights)), 3)
    interpolate = scipy.sparse.csr_matrix((np.tile(weights, (len(triangles), 1)).ravel(), (rows, columns)))
    weighted = interpolate.T @ scipy.sparse.diags(areas * normals[:, 2])
    vertices[:, 2] = scipy.sparse.linalg.spsolve((weighted @ interpolate).tocsc(), weighted @ heights)


def write_ply(path: Path, drawn: SurfaceMesh) -> None:
    """Write binary PLY, m: floats, and indices of two bytes, a quarter of what STL takes."""
    faces = np.zeros(len(drawn.triangles), dtype=[("count", "u1"), ("corners", "<u2", 3)])
    faces["count"], faces["corners"] = 3, drawn.triangles
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment nominal surface, metres\n"
        f"element vertex {len(drawn.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar ushort vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + drawn.vertices.astype("<f4").tobytes() + faces.tobytes())


if __name__ == "__main__":
    for name in TRIANGLES:
        write_ply(FOLDER / f"{name}.ply", draw(name))
