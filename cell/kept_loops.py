"""The loops that are compiled and kept on disk: by their number a first run tells how far its compiling is.

Loops are compiled where they are first called, in up to three processes; what all of them share is the disk.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

LOOPS = 105
"""About as many does a first dry run keep, calibration and job, the simulated world's own among them."""
_ROOTS = ("cell", "sim_backends")


def kept_loops() -> list[float]:
    """When each loop was kept for this Python, seconds since the epoch; a loop may have more than one version."""
    if folder := os.environ.get("NUMBA_CACHE_DIR"):
        roots = [Path(folder)]
    else:
        roots = [Path(__file__).parents[1] / name for name in _ROOTS]
    times = []
    for root in roots:
        for index in root.rglob(f"*.py{sys.version_info.major}{sys.version_info.minor}.nbi"):
            with suppress(OSError):
                times.append(index.stat().st_mtime)
    return times
