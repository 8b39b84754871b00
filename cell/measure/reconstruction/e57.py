"""Clouds as E57 (ASTM E2807), one scan a sweep, through libE57Format. Measured points only: the format has no mark for
interpolated ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.measure.reconstruction.ply import StoredCloud
from drivers.errors import ConfigError


def write_e57(path: Path, cloud: StoredCloud, colours: NDArray[np.uint8] | None = None) -> int:
    """Write the measured points, in m, arm base, with their row and column in the organised cloud; their number.

    `colours` (n, 3) uint8 are of all points of the cloud. Raises `ConfigError` that names the extra when the library
    is missing.
    """
    try:
        import pye57
    except ImportError as error:
        raise ConfigError(
            "E57 needs the library pye57, which is not installed: pip install 'assembly-cell[e57]'"
        ) from error
    path.unlink(missing_ok=True)
    file = pye57.E57(str(path), mode="w")
    count = 0
    try:
        for k in np.unique(cloud.sweep):
            mine = np.flatnonzero((cloud.sweep == k) & ~cloud.interpolated)
            data = {f"cartesian{axis}": cloud.points[mine, i] for i, axis in enumerate("XYZ")}
            data["rowIndex"] = cloud.row[mine].astype(np.int64)
            data["columnIndex"] = (cloud.line[mine] - cloud.line[mine].min()).astype(np.int64)
            if colours is not None:
                data |= {f"color{name}": colours[mine, i] for i, name in enumerate(("Red", "Green", "Blue"))}
            file.write_scan_raw(data, name=f"sweep {k + 1}")
            count += len(mine)
    finally:
        file.close()
    return count
