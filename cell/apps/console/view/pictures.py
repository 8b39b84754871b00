"""What the cell looks at, for the page: newest pictures with what was found in them, and the cloud as it grows.

Taken from what the steps have kept already; who shows them computes with copies, and only as many as are shown.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.procedures.sweep.swath import SweepCollector, Sweeping
from cell.run.run import Run
from drivers.interfaces import Frame

WIDTH = 640
"""Pictures are made smaller by whole numbers until they are no wider."""
STRIPE_POINTS = 160
ROWS = 12
"""Each so many-th row of a profile is shown."""

Sent = tuple[dict[str, Any], bytes]


class Pictures:
    """The newest picture of a run that was not given yet."""

    def __init__(self, target_names: tuple[str, ...] = ("board", "large", "target")) -> None:
        self._targets = target_names
        self._given: Frame | None = None
        self._found: object = None

    def newest(self, run: Run[Any]) -> tuple[dict[str, Any], NDArray[np.uint8]] | None:
        """Header and grey image (rows, columns), a copy; None when nothing new was looked at."""
        last = None if run.frames is None else run.frames.last
        found = None if run.frames is None else run.frames.found
        board = None
        if found is not None and found is not self._found:
            # Once more, with the board, which was found in it since.
            self._found = found
            what, (frame, board) = "board", found
        elif last is not None and last[1] is not self._given:
            what, frame = last
        else:
            return None
        self._given = frame
        step = max(1, -(-frame.image.shape[1] // WIDTH))
        small = np.ascontiguousarray(frame.image[::step, ::step])
        header = {
            "type": "picture",
            "camera": "target_camera" if what.startswith(self._targets) else "scan_camera",
            "what": what, "width": small.shape[1], "height": small.shape[0], "scale": 1.0 / step,
            "board": None if board is None else (board / step).round(1).tolist(), "stripe": None,
        }  # fmt: skip
        if what == "stripe" and run.sweeping is not None:
            header["stripe"] = _stripe(run.sweeping.collector, frame, step)
        return header, small


def _stripe(collector: SweepCollector, frame: Frame, step: int) -> list[list[float]] | None:
    """Where the stripe was found in this frame, in pixels of the small picture."""
    try:
        line = collector.frame_ids.index(frame.frame_id, max(0, len(collector.frame_ids) - 8))
    except ValueError:
        return None
    centres = collector.builder.centres(line)
    rows = np.flatnonzero(np.isfinite(centres))
    rows = rows[:: max(1, len(rows) // STRIPE_POINTS)]
    return [[round(float(centres[row]) / step, 1), round(float(row) / step, 1)] for row in rows]


class GrowingCloud:
    """The points of a sweep as they come, placed by where rail and arm were read last: good for looking at only."""

    def __init__(self) -> None:
        self._present: Sweeping | None = None
        self._sweep = -1
        self._next = 0
        self._total = 0
        self._points: list[NDArray[np.float32]] = []
        self._told: object = None

    def increment(self, run: Run[Any], flange: NDArray[np.float64] | None, rail: object) -> Sent | None:
        """The lines that came since; `flange` (4, 4) is base_from_flange now and `rail` the rail's motion."""
        present = run.sweeping
        if present is None:
            return None
        if present is not self._present:
            self._sweep += 1
            self._present, self._next = present, 0
        collector = present.collector
        known = min(len(collector.times), collector.builder.lines)
        if flange is None or known <= self._next:
            return None
        times = np.array(collector.times[self._next : known])
        places = _places(rail, times)
        lines = collector.builder.seen(self._next)[: known - self._next, ::ROWS].copy()
        header = {"type": "cloud", "sweep": self._sweep, "from": self._total, "reset": self._total == 0, "final": False}
        self._next = known
        geometry = collector.geometry
        mount = geometry.flange_from_camera
        moved = lines + places[:, None, None] * np.asarray(geometry.rail_direction)
        in_flange = moved @ mount.rotation.T + mount.translation
        points = (in_flange @ flange[:3, :3].T + flange[:3, 3]).reshape(-1, 3)
        points = points[np.isfinite(points[:, 0])]
        if not len(points):
            return None
        self._total += len(points)
        rows = np.empty((len(points), 4), dtype="<f4")
        rows[:, :3] = points
        surface = present.base_from_surface
        rows[:, 3] = present.nominal.deviations((points - surface.translation) @ surface.rotation)
        self._points.append(rows[:, :3])
        return {**header, "count": len(rows)}, rows.tobytes()

    def final(self, run: Run[Any]) -> Sent | None:
        """All points anew, with their distances from the surface where it was found; once, as soon as it was."""
        found, present = run.registered, run.sweeping
        if found is None or found is self._told or present is None or not self._points:
            return None
        self._told = found
        points = np.concatenate(self._points)
        deviations = present.nominal.deviations((points - found.translation) @ found.rotation)
        rows = np.column_stack([points, deviations]).astype("<f4")
        header = {"type": "cloud", "sweep": self._sweep, "from": 0, "reset": True, "final": True, "count": len(rows)}
        return header, rows.tobytes()


def _places(rail: object, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the rail was at these host times by its own readings, m; 0 for a sweep by the arm."""
    readings = list(getattr(rail, "readings", ()))
    if len(readings) < 2:
        return np.zeros(len(times))
    told = np.array([row[:2] for row in readings])
    return np.asarray(np.interp(times, told[:, 0], told[:, 1]))
