"""Clouds as binary PLY files that CloudCompare and MeshLab open; in metres, as the header's comment says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray


def write_ply(
    path: Path,
    points: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    quality: ArrayLike | None = None,
    colours: ArrayLike | None = None,
    comment: str = "",
) -> int:
    """Write the finite points (…, 3), in m; their number. Rows with NaN are left out.

    Optional, one per point: unit `normals` (…, 3), a scalar `quality` (such as the deviation in m) and `colours`
    (…, 3) uint8. Raises ValueError when the sizes differ.
    """
    xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    columns: list[tuple[str, str, NDArray[np.generic]]] = [(n, "<f4", xyz[:, i]) for i, n in enumerate("xyz")]
    if normals is not None:
        vectors = np.asarray(normals, dtype=np.float64).reshape(-1, 3)
        columns += [(n, "<f4", vectors[:, i]) for i, n in enumerate(("nx", "ny", "nz"))]
    if colours is not None:
        rgb = np.asarray(colours, dtype=np.uint8).reshape(-1, 3)
        columns += [(n, "u1", rgb[:, i]) for i, n in enumerate(("red", "green", "blue"))]
    if quality is not None:
        columns.append(("quality", "<f4", np.asarray(quality, dtype=np.float64).reshape(-1)))
    for name, _, values in columns:
        if len(values) != len(xyz):
            raise ValueError(f"{name} has {len(values)} values for {len(xyz)} points")
    keep = np.isfinite(xyz).all(axis=1)
    records = np.empty(int(keep.sum()), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        records[name] = values[keep]
    words = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment coordinates in metres"]
    header += [f"comment {line}" for line in comment.splitlines()]
    header += [f"element vertex {len(records)}", *(f"property {words[kind]} {name}" for name, kind, _ in columns)]
    path.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode("ascii", "replace") + records.tobytes())
    return len(records)


def deviation_colours(deviations: ArrayLike, limit: float) -> NDArray[np.uint8]:
    """Colours (…, 3) of deviations (…,) in m: blue at −limit, green at 0, red at +limit, grey where unknown (NaN)."""
    if not limit > 0:
        raise ValueError(f"the colour scale's limit {limit} m must be greater than 0")
    d = np.asarray(deviations, dtype=np.float64)
    share = np.clip(np.nan_to_num(d) / limit, -1.0, 1.0)
    colours = np.stack([np.clip(share, 0, 1), 1.0 - np.abs(share), np.clip(-share, 0, 1)], axis=-1)
    colours[~np.isfinite(d)] = 0.5
    return np.asarray(np.round(255 * colours), dtype=np.uint8)
