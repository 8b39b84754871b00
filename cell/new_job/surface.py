"""The surface that the cell will look for: the side of a mesh that a scan head above it sees, laid on the table.

A body has an underside and inner walls that no sweep sees; taken along, they would count as surface that was missed.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.geometry.poses import from_parts
from cell.new_job.mesh_file import Body
from cell.new_job.rays import ABOVE, Array, Faces, refined, seen_from
from cell.new_job.units import METRES
from drivers.errors import ConfigError

UP = {"z": (0, 0, 1), "-z": (0, 0, -1), "x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0)}
STEEPEST = 0.2
"""Least cosine between a triangle's normal and the way it is seen: a stripe on steeper ones is a smear."""
FINEST, PIECES = 0.001, 150
"""Triangles that are seen in part are divided until no side is longer, m, or than the surface's size over `PIECES`."""
LEAST_SEEN = 1e-4
"""Area, m², below which there is no surface to place anything onto: a centimetre squared."""


@dataclass(frozen=True, eq=False)
class Laid:
    """A mesh in the surface frame S: z up, its lowest point at z = 0, the middle of its box at x = y = 0. m.

    `surface_from_mesh` says where the file's own frame is, after its unit was turned into m.
    """

    vertices: Array
    faces: Faces
    surface_from_mesh: pin.SE3

    @property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest corner (3,) of what the triangles use, m."""
        used = self.vertices[self.faces].reshape(-1, 3)
        return used.min(axis=0), used.max(axis=0)


def lay(bodies: Sequence[Body], unit: str, up: str, turn: float | None) -> Laid:
    """The bodies with the axis `up` of their file up, turned by `turn` rad about it; without it the longer side lies
    along x, the way of the sweep."""
    vertices = METRES[unit] * np.concatenate([body.vertices for body in bodies])
    starts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    faces = np.concatenate([body.triangles + start for body, start in zip(bodies, starts, strict=False)])
    upright = _upright(up)
    if turn is None:
        across = np.ptp(vertices @ upright.T, axis=0)
        turn = 0.5 * np.pi if across[1] > across[0] else 0.0
    rotation = pin.rpy.rpyToMatrix(0.0, 0.0, turn) @ upright
    turned = vertices @ rotation.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    origin = np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])
    return Laid(turned - origin, faces, from_parts(-origin, rotation))


def _upright(up: str) -> Array:
    """The turn (3, 3) that brings the axis `up` of the mesh to z, by quarters of a turn."""
    axis = np.array(UP[up], dtype=float)
    if up == "z":
        return np.eye(3)
    if up == "-z":
        return np.diag([1.0, -1.0, -1.0])
    x = np.roll(np.abs(axis), 1)
    return np.stack([x, np.cross(axis, x), axis])


def faces_down(laid: Laid) -> bool:
    """Whether more of the surface faces down than up: an open mesh whose triangles are turned, or that lies upside
    down. A closed body faces both ways alike."""
    corners = laid.vertices[laid.faces]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    return bool(up.sum() < -0.01 * np.abs(up).sum())


def turned_over(laid: Laid) -> Laid:
    """The same triangles, facing the other way."""
    return Laid(laid.vertices, laid.faces[:, ::-1].copy(), laid.surface_from_mesh)


def open_side(laid: Laid, ways: Sequence[Array] = (ABOVE,)) -> Laid:
    """What lies open to an eye in one of the directions `ways` (3,), unit, S, and is not too steep for it.

    Raises `ConfigError` when that is next to nothing.
    """
    triangles, every = _seen(laid.vertices, laid.faces, ways)
    if not every:
        longest = max(FINEST, float(np.ptp(laid.vertices, axis=0).max()) / PIECES)
        vertices, faces = refined(laid.vertices, laid.faces, longest)
        seen, _ = _seen(vertices, faces, ways)
        return _required(Laid(vertices, faces[seen], laid.surface_from_mesh))
    return _required(Laid(laid.vertices, laid.faces[triangles], laid.surface_from_mesh))


def _seen(vertices: Array, faces: Faces, ways: Sequence[Array]) -> tuple[NDArray[np.bool_], bool]:
    """Which triangles are seen, and whether none that faces an eye is hidden from it, all or in part."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = np.zeros(len(faces), dtype=np.bool_)
    every = True
    for way in ways:
        facing = normals @ way > STEEPEST
        this = seen_from(vertices, faces, way) & facing
        every = every and bool(this[facing].all()) and bool((normals @ way > -1e-3).all())
        seen |= this
    return seen, every


def _required(laid: Laid) -> Laid:
    corners = laid.vertices[laid.faces]
    area = 0.5 * float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    )
    if area < LEAST_SEEN:
        raise ConfigError(
            f"{1e6 * area:.3g} mm² of the mesh can be seen from above (at least {1e6 * LEAST_SEEN:g} mm²): it stands "
            "on edge, or its triangles face down; turn it with --up, or its triangles round with --flip"
        )
    return laid


def as_stl(laid: Laid, text: str) -> bytes:
    """The triangles as a binary STL in mm; `text` is its heading, at most 80 characters."""
    corners = 1e3 * laid.vertices[laid.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    records = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    records["corners"] = corners
    return text.encode("ascii", "replace")[:80].ljust(80) + struct.pack("<I", len(records)) + records.tobytes()


def written(laid: Laid, path: Path, text: str) -> None:
    """Write it."""
    path.write_bytes(as_stl(laid, text))
