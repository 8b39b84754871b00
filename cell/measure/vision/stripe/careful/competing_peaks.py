"""Which of two peaks in a line is the stripe, and how wide the stripe is about there: what only the neighbours tell.

A reflection may be brighter than the stripe in some lines. There, the lines around that show one peak only say where
the stripe runs; where they say nothing, the peak with more energy stays, and the line is marked.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.vision.stripe.ordinary.find import CENTRE, ENERGY, WIDTH

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


@compiled
def survey(start: Any, low: float, high: float) -> tuple[Any, Any]:
    """What the lines say together: those found (m,) and how wide the stripe is about each line (lines,).

    The width in px is the running mean over 15 lines of the start widths within low … high, which are counts of pixels
    and coarse one by one.
    """
    lines = len(start)
    found = np.empty(lines, np.int64)
    # Sums over the lines before each.
    totals, counts = np.zeros(lines + 1), np.zeros(lines + 1, np.int64)
    for r in range(lines):
        totals[r + 1], counts[r + 1] = totals[r], counts[r]
        if start[r, 0, ENERGY] > 0:
            totals[r + 1] += min(max(start[r, 0, WIDTH], low), high)
            found[counts[r]] = r
            counts[r + 1] += 1
    widths = np.empty(lines)
    overall = totals[lines] / counts[lines] if counts[lines] > 0 else min(max(1.0, low), high)
    for r in range(lines):
        first, end = max(0, r - SMOOTHED), min(lines, r + SMOOTHED + 1)
        here = counts[end] - counts[first]
        widths[r] = (totals[end] - totals[first]) / here if here > 0 else overall
    return found[: counts[lines]], widths
