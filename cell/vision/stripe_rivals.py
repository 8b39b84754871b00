"""Which of two peaks in a line is the stripe, and how wide the stripe is about there: what only the neighbours tell.

A reflection may be brighter than the stripe in some lines. There, the lines around that show one peak only say where
the stripe runs; where they say nothing, the peak with more energy stays, and the line is marked.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.compiled import compiled
from cell.vision.stripe_find import CENTRE, ENERGY, WIDTH

Array = NDArray[np.float64]

DOUBLE = 0.5
"""Energy of the weaker peak over that of the stronger from which a line is marked as double."""
RIVAL = 0.15
# Lines on either side that are asked where the stripe runs, how many of them at most, and how near it has to be.
REACH, ASKED, NEAR = 30, 7, 4.0
SMOOTHED = 7


def choose(start: Array) -> NDArray[np.bool_]:
    """True (lines,) where two peaks compete; `start` (lines, 2, …) is put in order, the chosen one first."""
    energy = start[:, :, ENERGY]
    rival = energy[:, 1] > RIVAL * energy[:, 0]
    double: NDArray[np.bool_] = energy[:, 1] > DOUBLE * energy[:, 0]
    if not rival.any():
        return double
    alone = np.flatnonzero((energy[:, 0] > 0) & ~rival)
    for line in np.flatnonzero(rival):
        here = np.searchsorted(alone, line)
        sides = (alone[max(0, here - ASKED) : here], alone[here : here + ASKED])
        asked = np.concatenate([side[np.abs(side - line) <= REACH] for side in sides])
        if len(asked) < 3:
            continue
        slope, middle = _line_through(asked - line, start[asked, 0, CENTRE])
        away = np.abs(start[line, :, CENTRE] - middle)
        tolerance = NEAR + 0.5 * abs(slope) + start[line, 0, WIDTH]
        if away[1] < tolerance < away[0]:
            start[line] = start[line, ::-1]
            double[line] = True
    return double


def _line_through(x: Any, y: Any) -> tuple[float, float]:
    """Slope and value at 0 of a line that one bad point in four does not move: medians of slopes and of values."""
    i, j = np.triu_indices(len(x), 1)
    slope = float(np.median((y[j] - y[i]) / (x[j] - x[i])))
    return slope, float(np.median(y - slope * x))


def smooth_widths(start: Array, allowed: tuple[float, float]) -> Array:
    """Running mean over 15 lines of the start widths (lines,), which are counts of pixels and coarse one by one."""
    out = np.empty(len(start))
    _running_mean(start, allowed[0], allowed[1], out)
    return out


@compiled
def _running_mean(start: Any, low: float, high: float, out: Any) -> None:
    lines = len(out)
    total, count = 0.0, 0
    overall, found = 0.0, 0
    for r in range(lines):
        if start[r, 0, ENERGY] > 0:
            overall += min(max(start[r, 0, WIDTH], low), high)
            found += 1
    middle = overall / found if found > 0 else 1.0
    for r in range(-SMOOTHED, lines):
        new, old = r + SMOOTHED, r - SMOOTHED - 1
        if new < lines and start[new, 0, ENERGY] > 0:
            total += min(max(start[new, 0, WIDTH], low), high)
            count += 1
        if old >= 0 and start[old, 0, ENERGY] > 0:
            total -= min(max(start[old, 0, WIDTH], low), high)
            count -= 1
        if r >= 0:
            out[r] = min(max(total / count if count > 0 else middle, low), high)
