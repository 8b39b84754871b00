"""The surface that the cell will look for: the side of a mesh that a scan head above it sees, laid on the table.

A body has an underside and inner walls that no sweep sees; taken along, they would count as surface that was missed.

Bodies of one mesh that overlap: which do, and which of their faces lie in one another.

What lies inside a body is hidden by its outside and needs no care. Two faces at one place are both seen: one counts.
"""

import itertools
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.apps.new_job.mesh_file import MeshBody, joined
from cell.apps.new_job.sweeps import ABOVE, NEAR, Array, Faces, Rays
from cell.measure.geometry.poses import from_parts
from drivers.errors import ConfigError

METRES = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}
APART = 1e-4
"""Share of a body's size by which another has to reach into it to overlap: bodies that touch do not."""


def overlapping(bodies: Sequence[MeshBody]) -> list[tuple[int, int]]:
    """Pairs of numbers of bodies that reach into each other, or of which one lies inside the other."""
    pairs = [
        pair
        for pair in itertools.combinations(range(len(bodies)), 2)
        if _boxes_meet(*(bodies[k].vertices for k in pair))
    ]
    rays = {k: Rays(bodies[k].vertices, bodies[k].triangles) for k in {k for pair in pairs for k in pair}}
    return [
        (i, j) for i, j in pairs if _enters(bodies[i], bodies[j], rays[j]) or _enters(bodies[j], bodies[i], rays[i])
    ]


def _boxes_meet(one: Array, other: Array) -> bool:
    return bool((one.min(axis=0) <= other.max(axis=0)).all() and (other.min(axis=0) <= one.max(axis=0)).all())


def _enters(body: MeshBody, other: MeshBody, rays: Rays) -> bool:
    """Whether `body` has places of its surface inside `other`, which `rays` meet; where that is open, crosses it."""
    apart = APART * float(other.size.max())
    corners = body.vertices[body.triangles]
    begin, way = corners.reshape(-1, 3), (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    length = np.linalg.norm(way, axis=1)
    way /= length[:, None]
    _, met = rays.hits(begin, way)
    crossed = np.flatnonzero((met > apart) & (met < length - apart))
    if not other.closed:
        return len(crossed) > 0
    # A little inside `body` itself, so that faces that only touch do not count.
    inwards = np.cross(corners[:, 2] - corners[:, 0], corners[:, 1] - corners[:, 0])
    inwards *= apart / np.linalg.norm(inwards, axis=1, keepdims=True)
    at = [
        begin[crossed] + (met[crossed] + step)[:, None] * way[crossed] + inwards[crossed // 3]
        for step in (-apart, apart)
    ]
    places = np.concatenate([corners.mean(axis=1) + inwards, *at])
    triangle, met = rays.hits(places, np.tile(ABOVE, (len(places), 1)))
    return bool(((triangle >= 0) & (met > 0.1 * apart) & (rays.normals[triangle] @ ABOVE > 0.0)).any())


def before(vertices: Array, faces: Faces) -> tuple[NDArray[np.intp], list[Rays | None]]:
    """(m,) the body of each triangle, and for each body the earlier ones that its box meets, None where there are none.
    A place of a body that lies on one of those is there twice."""
    body = np.unique(joined(faces, len(vertices)), return_inverse=True)[1].reshape(-1).astype(np.intp)
    parts = [faces[body == k] for k in range(int(body.max(initial=-1)) + 1)]
    corners = [vertices[part.ravel()] for part in parts]
    earlier: list[Rays | None] = []
    for k in range(len(parts)):
        met = [parts[j] for j in range(k) if _boxes_meet(corners[k], corners[j])]
        earlier.append(Rays(vertices, np.concatenate(met)) if met else None)
    return body, earlier


UP = {"z": (0, 0, 1), "-z": (0, 0, -1), "x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0)}
STEEPEST = 0.2
"""Least cosine between a triangle's normal and the way it is seen: a stripe on steeper ones is a smear."""
FINEST, PIECES = 0.001, 150
"""Triangles that are seen in part are halved until no side is longer, m, or than the surface's size over `PIECES`."""
MOST_PLACES = 40
"""Places along a triangle's longest side that are looked at, at most."""
FAR = 2.0
"""How far away the eye is, m."""
LEAST_SEEN = 1e-4
"""Area, m², below which there is no surface to place anything onto: a centimetre squared."""


@dataclass(frozen=True, eq=False)
class Laid:
    """A mesh in the surface frame S: z up, the middle of its box at x = y = 0. m. `surface_from_mesh` says where the
    file's own frame is, after its unit was turned into m; `foot` how far the table's top is below the origin, m."""

    vertices: Array
    faces: Faces
    surface_from_mesh: pin.SE3
    foot: float = 0.0

    @property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest corner (3,) of what the triangles use, m."""
        used = self.vertices[self.faces].reshape(-1, 3)
        return used.min(axis=0), used.max(axis=0)


def lay(bodies: Sequence[MeshBody], unit: str, up: str, turn: float | None) -> Laid:
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


def about(laid: Laid) -> Laid:
    """The same, turned by half a turn about z."""
    turn = from_parts(np.zeros(3), np.diag([-1.0, -1.0, 1.0]))
    return replace(laid, vertices=laid.vertices @ turn.rotation.T, surface_from_mesh=turn * laid.surface_from_mesh)


def faces_down(laid: Laid) -> bool:
    """Whether more of the surface faces down than up: an open mesh whose triangles are turned, or that lies upside
    down. A closed body faces both ways alike."""
    corners = laid.vertices[laid.faces]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    return bool(up.sum() < -0.01 * np.abs(up).sum())


def raised(laid: Laid, height: float) -> Laid:
    """The same mesh with its origin `height` m lower, the table where it is."""
    up = from_parts((0.0, 0.0, height))
    return Laid(laid.vertices + up.translation, laid.faces, up * laid.surface_from_mesh, laid.foot - height)


def centred(laid: Laid) -> Laid:
    """The same mesh with its origin half-way up what is seen of it from above, in whole mm: there the scan head is set
    up, and tilted about."""
    low, high = open_side(laid).box
    return raised(laid, -round(0.5 * float(low[2] + high[2]), 3))


def open_side(laid: Laid, ways: Sequence[Array] = (ABOVE,), notify: Callable[[str], None] = lambda text: None) -> Laid:
    """What lies open to an eye in one of the directions `ways` (3,), unit, S, and is not too steep for it.

    A triangle that is hidden in part is halved until its pieces are small. Where faces of overlapping bodies lie at
    one place, the first body's counts. `notify` gets the progress. Raises `ConfigError` when next to nothing is seen.
    """
    rays = Rays(laid.vertices, laid.faces)
    body, earlier = before(laid.vertices, laid.faces)
    finest = max(FINEST, float(np.ptp(laid.vertices, axis=0).max()) / PIECES)
    corners, normals = laid.vertices[laid.faces], rays.normals
    towards = np.array(ways)
    facing = (normals @ towards.T > STEEPEST).any(axis=1)
    pieces, normals, body = corners[facing], normals[facing], body[facing]
    kept = []
    while len(pieces):
        notify(f"what lies open to the scan head: {len(pieces)} triangles to look at")
        share = np.zeros(len(pieces))
        for k in np.unique(body):
            mine = body == k
            share[mine] = _seen_share(pieces[mine], normals[mine], rays, earlier=earlier[k], ways=towards, step=finest)
        longest = np.linalg.norm(pieces - np.roll(pieces, -1, axis=1), axis=2).max(axis=1)
        mixed = (share > 0.0) & (share < 1.0) & (longest > finest)
        kept.append(pieces[~mixed & (share > 0.5)])
        pieces, normals, body = _halved(pieces[mixed]), np.repeat(normals[mixed], 2, axis=0), np.repeat(body[mixed], 2)
    triangles = np.concatenate(kept) if kept else np.empty((0, 3, 3))
    vertices, numbers = np.unique(np.round(triangles.reshape(-1, 3), 9), axis=0, return_inverse=True)
    return _required(replace(laid, vertices=vertices, faces=numbers.reshape(-1, 3)))


def _seen_share(pieces: Array, normals: Array, rays: Rays, earlier: Rays | None, ways: Array, step: float) -> Array:
    """(n,) which share of places `step` m apart on each triangle (n, 3, 3) is seen from one of the ways (k, 3), and
    does not lie on an `earlier` body as well."""
    longest = np.linalg.norm(pieces - np.roll(pieces, -1, axis=1), axis=2).max(axis=1)
    divisions = np.clip(np.ceil(longest / step), 1, MOST_PLACES).astype(np.intp)
    share = np.zeros(len(pieces))
    for n in np.unique(divisions):
        mine = np.flatnonzero(divisions == n)
        i, j = np.nonzero(np.add.outer(np.arange(n), np.arange(n)) < n)
        weights = np.column_stack([i + 1 / 3, j + 1 / 3]) / n
        weights = np.column_stack([1.0 - weights.sum(axis=1), weights])
        points = np.einsum("sk,nki->nsi", weights, pieces[mine])
        seen = np.zeros(points.shape[:2], dtype=np.bool_)
        for way in ways:
            ask = np.flatnonzero(normals[mine] @ way > STEEPEST)
            places = points[ask].reshape(-1, 3)
            open_there = rays.open_between(places, places + FAR * way)
            if earlier is not None:
                open_there &= np.abs(earlier.behind(places, places + FAR * way)) > NEAR
            seen[ask] |= open_there.reshape(len(ask), len(weights))
        share[mine] = seen.mean(axis=1)
    return share


def _halved(pieces: Array) -> Array:
    """Each triangle (n, 3, 3) as two, (2 n, 3, 3): its longest side is divided."""
    sides = np.linalg.norm(pieces - np.roll(pieces, -1, axis=1), axis=2)
    first = np.argmax(sides, axis=1)
    a, b, c = (np.take_along_axis(pieces, ((first + k) % 3)[:, None, None], axis=1)[:, 0] for k in range(3))
    middle = 0.5 * (a + b)
    return np.stack([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)], axis=1).reshape(-1, 3, 3)


def _required(laid: Laid) -> Laid:
    corners = laid.vertices[laid.faces]
    area = 0.5 * float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    )
    if area < LEAST_SEEN:
        raise ConfigError(
            f"{1e6 * area:.3g} mm² of the mesh can be seen from above (at least {1e6 * LEAST_SEEN:g} mm²): it has "
            "another --unit, stands on edge, or faces down; turn it with --up, or its triangles round with --flip"
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
