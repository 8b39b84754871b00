"""Centres that depart from the line that their neighbours make: light near the stripe that the fit has absorbed.

A spot within two pixels of the stripe looks like a stripe that is a little wider, and its own line fits well. Only the
lines beside it, which the spot does not reach, tell. What departs keeps its centre and is stated to be off by as much.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.base.compiled import compiled

BLOCK, BESIDE = 16, 24
"""Lines that are judged by one curve; lines on either side that shape it: more than a spot covers."""
LEAST, LAG = 12, 4
"""Centres that make a curve, at least; by so many centres apart the slope is begun with."""
DEPARTS, LESS, SUSPECT = 4.0, 2.0, 3.0
"""Departure over the larger of the stated deviation and the neighbours' scatter: beyond chance (6e-5 of lines), beyond
it beside a line that departs, and worth a look."""
BREAK_PX = 1.0
"""From one line to the next, beyond the line's slope."""
ROUNDS, SCALED, TUKEY = 5, 3, 4.685
"""Of the robust fit; those in which the scatter is taken anew; its cut in deviations: 95 % efficient on clean lines."""


@compiled
def widen_what_departs(centres: Any, sigma: Any) -> None:
    """Widen `sigma` (lines,) px, in place, of those `centres` (lines,) px that depart from their neighbours' curve.

    Where an edge breaks the line a centre may go on from either side: the nearest of three curves counts. NaN where
    there is no stripe.
    """
    lines = len(centres)
    blocks = (lines + BLOCK - 1) // BLOCK
    curves, known = np.zeros((blocks, 5)), np.zeros(blocks, np.bool_)
    off, usual = np.zeros(lines), np.ones(lines)
    for block in range(blocks):
        own = range(block * BLOCK, min(lines, (block + 1) * BLOCK))
        plain = _curve(centres, sigma, block * BLOCK, 1)
        suspect = False
        for r in own:
            suspect = suspect or abs(centres[r] - _at(plain, r)) > SUSPECT * sigma[r]
        if not suspect or plain[3] == 0.0:
            continue
        for r in own:
            off[r] = np.inf
        beside = 0
        for r in range(max(1, block * BLOCK - 1), min(lines, (block + 1) * BLOCK + 1)):
            # A spot bends the line, an edge breaks it.
            beside = max(beside, int(abs(centres[r] - centres[r - 1] - plain[1] / BESIDE) > BREAK_PX))
        for k in range(max(0, block - beside), min(blocks, block + beside + 1)):
            if not known[k]:
                curves[k], known[k] = _curve(centres, sigma, k * BLOCK, ROUNDS), True
            for r in own:
                away = abs(centres[r] - _at(curves[k], r))
                if curves[k, 3] > 0.0 and away < off[r]:
                    off[r], usual[r] = away, max(sigma[r], curves[k, 4])
    departs = np.isfinite(off) & (off > DEPARTS * usual)
    # A spot covers several lines: beside one that departs less tells.
    for r in range(1, lines):
        departs[r] |= departs[r - 1] and LESS * usual[r] < off[r] < np.inf
    for r in range(lines - 2, -1, -1):
        departs[r] |= departs[r + 1] and LESS * usual[r] < off[r] < np.inf
    for r in range(lines):
        if departs[r]:
            sigma[r] = np.hypot(sigma[r], off[r])


@compiled
def _at(curve: Any, line: int) -> float:
    """The curve's place, px, in a line."""
    t = (line - curve[3]) / BESIDE
    return float(curve[0] + t * (curve[1] + t * curve[2]))


@compiled
def _curve(centres: Any, sigma: Any, begin: int, rounds: int) -> Any:
    """Parabola through the lines from `begin` to `begin + BLOCK` and those beside: three coefficients, its origin (0
    where too few lines have a centre) and the lines' scatter about it, px. Of one round it is not robust."""
    made = np.zeros(5)
    low, high = max(0, begin - BESIDE), min(len(centres), begin + BLOCK + BESIDE)
    t, y, weight = np.empty(high - low), np.empty(high - low), np.empty(high - low)
    n, origin = 0, begin + 0.5 * BLOCK
    for r in range(low, high):
        if np.isfinite(centres[r]):
            t[n], y[n], weight[n] = (r - origin) / BESIDE, centres[r], 1.0 / max(sigma[r] * sigma[r], 1e-12)
            n += 1
    if n < LEAST:
        return made
    t, y, weight = t[:n], y[:n], weight[:n]
    usual = np.median(weight) ** -0.5
    made[3] = origin
    if rounds > 1:
        # A step or a spot changes few of the slopes.
        made[1] = np.median((y[LAG:] - y[:-LAG]) / (t[LAG:] - t[:-LAG]))
        made[0] = np.median(y - made[1] * t)
    for turn in range(rounds):
        s0, s1, s2, s3, s4, r0, r1, r2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if rounds > 1 and turn < SCALED:
            made[4] = 1.4826 * np.median(np.abs(y - (made[0] + t * (made[1] + t * made[2]))))
        cut = TUKEY * max(made[4], usual)
        for i in range(n):
            x, w = t[i], weight[i]
            if rounds > 1:
                z = (y[i] - made[0] - x * (made[1] + x * made[2])) / cut
                w *= max(0.0, 1.0 - z * z) ** 2
            s0, s1, s2, s3, s4 = s0 + w, s1 + w * x, s2 + w * x * x, s3 + w * x**3, s4 + w * x**4
            r0, r1, r2 = r0 + w * y[i], r1 + w * y[i] * x, r2 + w * y[i] * x * x
        # Cramer's rule.
        a, b, c = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
        d, e, f = s0 * s4 - s2 * s2, s1 * s2 - s0 * s3, s0 * s2 - s1 * s1
        whole = s0 * a + s1 * b + s2 * c
        if whole <= 1e-9 * s0 * s2 * s4:
            made[3] = 0.0
            return made
        made[0], made[1], made[2] = a * r0 + b * r1 + c * r2, b * r0 + d * r1 + e * r2, c * r0 + e * r1 + f * r2
        made[:3] /= whole
    return made
