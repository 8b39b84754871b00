"""Clouds as files: binary PLY with all that a later export needs, and meshes (PLY or STL).

Coordinates are in metres. A mesh has triangles between neighbours of the organised cloud, none across a depth edge.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cell.base.storage import replacing
from cell.measure.reconstruction.cloud import Array, Cloud, Indices
from drivers.errors import ConfigError

_WORDS = {"f4": "float", "u1": "uchar", "u2": "ushort", "i4": "int"}
_KINDS = {
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1", "char": "i1",
    "int8": "i1", "ushort": "<u2", "uint16": "<u2", "short": "<i2", "int16": "<i2", "int": "<i4", "int32": "<i4",
    "uint": "<u4", "uint32": "<u4",
}  # fmt: skip


def write_ply(
    path: Path, points: ArrayLike, *, quality: ArrayLike | None = None, colours: ArrayLike | None = None,
    scalars: Mapping[str, NDArray[np.generic]] | None = None, comment: str = "",
) -> int:  # fmt: skip
    """Write the finite points (…, 3), in m; their number. Rows with NaN are left out.

    Optional, one per point: a scalar `quality` (such as the deviation in m), `colours` (…, 3) uint8, and `scalars` by
    name, of type float32, uint8, uint16 or int32. Raises ValueError when the sizes differ.
    """
    xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    columns: list[tuple[str, str, NDArray[np.generic]]] = [(n, "<f4", xyz[:, i]) for i, n in enumerate("xyz")]
    if colours is not None:
        rgb = np.asarray(colours, dtype=np.uint8).reshape(-1, 3)
        columns += [(n, "u1", rgb[:, i]) for i, n in enumerate(("red", "green", "blue"))]
    if quality is not None:
        columns.append(("quality", "<f4", np.asarray(quality, dtype=np.float64).reshape(-1)))
    for name, values in (scalars or {}).items():
        columns.append((name, np.dtype(values.dtype).newbyteorder("<").str.lstrip("|"), values.reshape(-1)))
    for name, _, values in columns:
        if len(values) != len(xyz):
            raise ValueError(f"{name} has {len(values)} values for {len(xyz)} points")
    keep = np.isfinite(xyz).all(axis=1)
    records = np.empty(int(keep.sum()), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        records[name] = values if len(records) == len(xyz) else values[keep]
    header = ["ply", "format binary_little_endian 1.0", "comment coordinates in metres"]
    header += [f"comment {line}" for line in comment.splitlines()]
    header.append(f"element vertex {len(records)}")
    header += [f"property {_WORDS[kind.lstrip('<')]} {name}" for name, kind, _ in columns]
    with replacing(path) as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii", "replace") + records.tobytes())
    return len(records)


def write_cloud(path: Path, cloud: Cloud, simulated: Sequence[str] = ()) -> int:
    """Write a cloud with all that a later export needs of it, interpolated points at its end; the number of points.

    The header names the devices that were `simulated` when it was measured.

    Properties beside x, y, z: `sigma` (one standard deviation, m, in the direction in which the point is least
    certain), `line`, `row` and `sweep` (where it lies in the organised cloud), `interpolated` (1 for a point that was
    not measured but interpolated).
    """
    lines, rows = np.nonzero(cloud.valid)
    filled = cloud.filled
    a, b = cloud.stripe_spread[lines, rows].astype(np.float64), cloud.rail_spread[lines]
    aa, bb, ab = (np.einsum("ni,ni->n", u, v) for u, v in ((a, a), (b, b), (a, b)))
    # The larger eigenvalue of a aᵀ + b bᵀ.
    most = 0.5 * (aa + bb) + np.sqrt(0.25 * (aa - bb) ** 2 + ab**2)
    most_filled = np.linalg.eigvalsh(filled.covariances)[:, 2] if len(filled.lines) else np.empty(0)
    line = np.concatenate([lines, filled.lines])
    flag = np.zeros(len(line), dtype=np.uint8)
    flag[len(lines) :] = 1
    said = f"\nsimulated: {', '.join(simulated)}" if simulated else ""
    return write_ply(
        path,
        np.concatenate([cloud.points[lines, rows], filled.points]),
        scalars={
            "sigma": np.sqrt(np.concatenate([most, most_filled])).astype(np.float32),
            "line": line.astype(np.int32),
            "row": np.concatenate([rows, filled.rows]).astype(np.int32),
            "sweep": cloud.sweep_of[line].astype(np.uint8),
            "interpolated": flag,
        },
        comment="frame: arm base\nsigma in metres; interpolated: 1 where the point was not measured" + said,
    )


@dataclass(frozen=True, eq=False)
class StoredCloud:
    """A cloud read back: points (n, 3) in m, arm base, and what was written of each: `sigma` (n,) in m, `line`, `row`
    and `sweep` (n,), `interpolated` (n,)."""

    points: NDArray[np.float64]
    sigma: NDArray[np.float64]
    line: NDArray[np.intp]
    row: NDArray[np.intp]
    sweep: NDArray[np.intp]
    interpolated: NDArray[np.bool_]


def _columns(head: bytes) -> tuple[list[tuple[str, str]], int]:
    """Name and kind of each column that the header tells, and the number of points; -1 where it is spoilt."""
    words = [line.split() for line in head.decode("ascii", "replace").splitlines() if line.count(" ") == 2]
    kinds = [(name, _KINDS.get(kind, "")) for what, kind, name in words if what == "property"]
    counts = [many for *what, many in words if what == ["element", "vertex"] and many.isdecimal()]
    sound = len(counts) == 1 and len(dict(kinds)) == len(kinds) and all(kind for _, kind in kinds)
    return kinds, int(counts[0]) if sound else -1


def read_cloud(path: Path) -> StoredCloud:
    """Read what `write_cloud` wrote. Raises `ConfigError` when the file is not there or holds something else."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"the cloud {path} cannot be read: {error}; did the run come as far as `reconstruct`?"
        ) from error
    head, mark, body = data.partition(b"end_header\n")
    kinds, count = _columns(head)
    needed = {"x", "y", "z", "sigma", "line", "row", "sweep", "interpolated"} - {name for name, _ in kinds}
    if not mark or needed or count < 0 or count * np.dtype(kinds).itemsize != len(body):
        lacking = f"lacks {', '.join(sorted(needed))}" if needed else "is not whole"
        raise ConfigError(f"{path} is no cloud of this program: it {lacking}; name the folder of a run of this version")
    records = np.frombuffer(body, dtype=kinds, count=count)
    whole = {name: records[name].astype(np.intp) for name in ("line", "row", "sweep")}
    return StoredCloud(
        points=np.column_stack([records[axis] for axis in "xyz"]).astype(np.float64),
        sigma=records["sigma"].astype(np.float64), interpolated=records["interpolated"] > 0, **whole,
    )  # fmt: skip


def deviation_colours(deviations: ArrayLike, limit: float) -> NDArray[np.uint8]:
    """Colours (…, 3) of deviations (…,) in m: blue at −limit, green at 0, red at +limit, grey where unknown (NaN)."""
    if not limit > 0:
        raise ValueError(f"the colour scale's limit {limit} m must be greater than 0")
    d = np.asarray(deviations, dtype=np.float64)
    share = np.clip(np.nan_to_num(d) / limit, -1.0, 1.0)
    colours = np.stack([np.clip(share, 0, 1), 1.0 - np.abs(share), np.clip(-share, 0, 1)], axis=-1)
    colours[~np.isfinite(d)] = 0.5
    return np.asarray(np.round(255 * colours), dtype=np.uint8)


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
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mean = normals.sum(axis=0)
    size = np.linalg.norm(normals, axis=1) * np.linalg.norm(mean)
    good = (lengths < LONGEST * np.median(lengths)) & (normals @ mean > STEEPEST * size)
    return np.asarray(faces[good], dtype=np.intp)


def write_mesh(path: Path, points: Array, faces: Indices, colours: NDArray[np.uint8] | None = None) -> int:
    """Write the mesh in metres as PLY, or as binary STL (without colours) when `path` ends so; its triangles' number.
    Vertices that no triangle uses are left out."""
    import trimesh

    used, numbers = np.unique(faces, return_inverse=True)
    mesh = trimesh.Trimesh(
        points[used], numbers.reshape(faces.shape), vertex_colors=None if colours is None else colours[used],
        process=False,
    )  # fmt: skip
    with replacing(path) as file:
        mesh.export(file, file_type="stl" if path.suffix.lower() == ".stl" else "ply")
    return len(faces)
