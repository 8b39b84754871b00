"""A mesh file as somebody drew it, and what is wrong with it: told by number and value, put right where that is safe.

Put right are triangles without an area, triangles that are there twice, and ones that are turned against their
neighbours or inside out in a closed body. What only a person can decide is asked: which bodies, which unit, which side.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from drivers.errors import ConfigError

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

STEP = (".step", ".stp")
STEP_CHORD = 0.005
"""How far the triangles may lie off the drawn surfaces of a STEP file, in the file's unit, mm as a rule."""
STEP_ANGLE = 0.1
"""And how far two neighbours may turn, rad."""
MOST_TRIANGLES = 3_000_000
SAME_PLACE = 1e-6
"""Corners nearer than this share of the mesh's size are one."""
FARTHEST = 1e9
"""In the file's unit, whatever it is."""
LEAST_SHARE = 1e-12
"""A triangle smaller than this share of the square of the mesh's size has no area."""


@dataclass(frozen=True, eq=False)
class MeshBody:
    """One connected body: `vertices` (n, 3) in the file's unit, `triangles` (m, 3), and whether it is `closed`."""

    vertices: Array
    triangles: Faces
    closed: bool

    @property
    def size(self) -> Array:
        """Sides (3,) of the box around it."""
        return np.asarray(np.ptp(self.vertices, axis=0))


class Drawn(NamedTuple):
    """The bodies of a file, the largest first, the unit that the file itself states, if it does, and `notes`: what was
    wrong and was put right, or is as it is."""

    path: Path
    bodies: tuple[MeshBody, ...]
    unit: str | None
    notes: tuple[str, ...]


def read_drawing(path: Path) -> Drawn:
    """Read an STL, PLY, OBJ or STEP file. Raises `ConfigError` when it is none, or holds no triangles."""
    if not path.is_file():
        raise ConfigError(f"the mesh {path} is not a file; name an STL, PLY or STEP with --mesh")
    vertices, faces = _loaded(path)
    if not len(faces) or vertices.ndim != 2:
        raise ConfigError(f"the mesh {path} holds no triangles; export the surface as a triangle mesh, not as points")
    if len(faces) > MOST_TRIANGLES:
        raise ConfigError(
            f"the mesh {path} has {len(faces)} triangles (allowed: at most {MOST_TRIANGLES}); export it more coarsely"
        )
    if bad := int((~np.isfinite(vertices)).any(axis=1).sum()):
        raise ConfigError(f"{bad} corners of the mesh {path} are no numbers; export it again")
    if not (np.abs(vertices).max() <= FARTHEST and 0 <= faces.min() <= faces.max() < len(vertices)):
        raise ConfigError(
            f"the mesh {path} names corners that it does not have, or that lie farther than {FARTHEST:g} of its units "
            "away; export it again"
        )
    notes: list[str] = []
    vertices, faces = _joined(vertices, faces)
    faces = _without_area(vertices, faces, notes)
    if not len(faces):
        raise ConfigError(f"no triangle of the mesh {path} has an area; export it again")
    bodies = [_turned(vertices, part, notes) for part in _parts(faces, len(vertices))]
    bodies.sort(key=lambda body: -float(np.prod(np.maximum(body.size, 1e-9))))
    # Bodies by the hundred need no line each.
    if len(notes) > 6:
        notes = [*notes[:5], f"… and {len(notes) - 5} more like these"]
    return Drawn(path, tuple(bodies), "m" if path.suffix.lower() in STEP else None, tuple(notes))


def _loaded(path: Path) -> tuple[Array, Faces]:
    import trimesh

    settings: dict[str, Any] = {}
    if path.suffix.lower() in STEP:
        try:
            import cascadio  # noqa: F401
        except ImportError as error:
            raise ConfigError(
                f"{path} is a STEP file, read by cascadio: in the checkout pip install -e '.[step]', or export an STL"
            ) from error
        settings = {"tol_linear": STEP_CHORD, "tol_angular": STEP_ANGLE}
    try:
        mesh = trimesh.load_mesh(path, process=False, **settings)
        return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    except Exception as error:  # every reader of trimesh raises its own
        raise ConfigError(f"{path} cannot be read as a mesh; give an STL, PLY or STEP") from error


def _joined(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Corners at the same place are one: an STL has three for each triangle, a STEP some for each of its faces."""
    grain = SAME_PLACE * max(float(np.ptp(vertices[faces.ravel()], axis=0).max()), 1e-9)
    _, first, one = np.unique(np.round(vertices / grain), axis=0, return_index=True, return_inverse=True)
    return vertices[first], one.reshape(-1)[faces]


def _without_area(vertices: Array, faces: Faces, notes: list[str]) -> Faces:
    corners = vertices[faces]
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    solid = doubled > LEAST_SHARE * float(np.ptp(vertices, axis=0).max()) ** 2
    if not solid.all():
        notes.append(f"{int((~solid).sum())} triangles without an area left out")
    kept = faces[solid]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    if len(first) < len(kept):
        notes.append(f"{len(kept) - len(first)} triangles that are there twice left out")
    found: Faces = kept[np.sort(first)]
    return found


def joined(faces: Faces, corners: int) -> Faces:
    """(m,) a number for each triangle, the same for those that share corners, of which there are so many."""
    first, second = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(corners, corners))
    return np.asarray(connected_components(links, directed=False)[1][faces[:, 0]], dtype=np.int64)


def _parts(faces: Faces, corners: int) -> list[Faces]:
    """Triangles that share corners."""
    mine = joined(faces, corners)
    order = np.argsort(mine, kind="stable")
    return np.split(faces[order], np.flatnonzero(np.diff(mine[order])) + 1)


def _turned(vertices: Array, faces: Faces, notes: list[str]) -> MeshBody:
    """A body whose triangles all face the same way, outwards where it is closed."""
    used, renumbered = np.unique(faces, return_inverse=True)
    corners, before = vertices[used], renumbered.reshape(-1, 3)
    ways = before[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, edge, count = np.unique(np.sort(ways, axis=1), axis=0, return_inverse=True, return_counts=True)
    lone, crowded = int((count == 1).sum()), int((count > 2).sum())
    over = _turned_over(ways, edge.reshape(-1), count, len(before))
    faces = np.where(over[:, None], before[:, ::-1], before)
    a, b, c = (corners - corners.mean(axis=0))[faces].transpose(1, 0, 2)
    # By its volume it is inside out.
    if lone == 0 and np.einsum("ni,ni->", a, np.cross(b, c)) < 0.0:
        over = ~over
    if over.any():
        notes.append(f"{int(over.sum())} triangles turned round: they faced against their neighbours, or into the body")
    if lone:
        why = "a surface with a border, or holes in a body" if lone < 0.5 * len(count) else "triangles that do not join"
        notes.append(f"open: {lone} edges belong to one triangle only ({why})")
    if crowded:
        notes.append(f"{crowded} edges belong to more than two triangles: bodies meet there, or walls lie inside")
    return MeshBody(corners, np.where(over[:, None], before[:, ::-1], before), lone == 0)


def _turned_over(ways: Faces, edge: Faces, count: Faces, faces: int) -> NDArray[np.bool_]:
    """(faces,) which triangles to turn over so that neighbours face the same way, as few as possible.

    `ways` (3 faces, 2) are their sides from corner to corner, `edge` the number of each and `count` how many share it.
    Each triangle is there twice, as it is and turned over; what faces the same way is linked.
    """
    order = np.argsort(edge, kind="stable")
    first = (np.cumsum(count) - count)[count == 2]
    one, two = order[first], order[first + 1]
    against = ways[one, 0] == ways[two, 0]
    a, b = one // 3, two // 3
    links = np.concatenate([np.stack([a, b + faces * against]), np.stack([a + faces, b + faces * ~against])], axis=1)
    made = coo_matrix((np.ones(links.shape[1]), (links[0], links[1])), shape=(2 * faces, 2 * faces))
    _, label = connected_components(made, directed=False)
    whole = np.bincount(label[:faces], minlength=2 * faces)
    as_is, turned = label[:faces], label[faces:]
    return np.asarray((whole[turned] > whole[as_is]) | ((whole[turned] == whole[as_is]) & (turned < as_is)))
