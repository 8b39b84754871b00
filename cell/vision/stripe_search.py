"""Where the stripe is in each line of the picture: the lines are searched `LANES` at a time.

In nearly all lines the brightest pixel is the stripe's, near where the line before has it, and nothing else stands
out. These are measured side by side in the processor's vector unit; any other is left to `stripe_find.find_line`,
which would say the same of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.compiled import compiled, compiled_fast
from cell.vision.stripe_find import (
    BACKGROUND,
    CENTRE,
    CORE,
    ENERGY,
    HEIGHT,
    SEARCH,
    WIDTH,
    find_line,
    first_at,
    largest,
    largest_outside,
    reach_of,
    rival_limit,
    width_of,
)
from cell.vision.stripe_lanes import LANES

PIXELS = 2 * SEARCH + 1
# Rows of the sums of a window: its background, what half of the peak and a fifth of it reach, how far the peak stands
# above the higher side; sums of the values, of what lies above a fifth and its moment; pixels above half.
_BACKGROUND, _HALF, _FIFTH, _RISE, _TOTAL, _OVER, _MOMENT, _ABOVE = range(8)
_SUMS = 8


@compiled_fast
def _sum_windows(window: Any, s: Any) -> None:
    """The sums (_SUMS, LANES) of the windows (PIXELS, LANES) around the lanes' peaks."""
    quarter, half, fifth = np.float32(0.25), np.float32(0.5), np.float32(0.2)
    zero, one = np.float32(0.0), np.float32(1.0)
    last = PIXELS - 1
    for j in range(LANES):
        left = quarter * (window[0, j] + window[1, j] + window[2, j] + window[3, j])
        right = quarter * (window[last, j] + window[last - 1, j] + window[last - 2, j] + window[last - 3, j])
        background, peak = half * (left + right), window[SEARCH, j]
        s[_BACKGROUND, j] = background
        s[_HALF, j] = background + half * (peak - background)
        s[_FIFTH, j] = background + fifth * (peak - background)
        s[_RISE, j] = peak - max(left, right)
        s[_TOTAL, j] = s[_OVER, j] = s[_MOMENT, j] = s[_ABOVE, j] = zero
    for i in range(PIXELS):
        place = np.float32(i)
        for j in range(LANES):
            value = window[i, j]
            over = max(value - s[_FIFTH, j], zero)
            s[_TOTAL, j] += value
            s[_OVER, j] += over
            s[_MOMENT, j] += place * over
            s[_ABOVE, j] += one if value > s[_HALF, j] else zero


@compiled
def _near(row: Any, guess: int, top: int) -> int:
    """Where a line first reaches `top` within SEARCH of a guess, else where it does at all."""
    low = max(0, guess - SEARCH)
    part = row[low : guess + SEARCH + 1]
    for i in range(len(part)):
        if part[i] >= top:
            return low + i
    return int(first_at(row, top))


@compiled
def _copy_window(image: Any, dark: Any, r: int, low: int, j: int, window: Any) -> None:
    """The pixels of line `r` from `low` on, above the dark frame, into lane `j`."""
    line, lane = image[r, low : low + PIXELS], window[:, j]
    for i in range(PIXELS):
        lane[i] = line[i]
    if len(dark) > 1:
        shade = dark[r, low : low + PIXELS]
        for i in range(PIXELS):
            lane[i] -= shade[i]


@compiled_fast
def _largest_beside(seen: Any, first: int, size: int, places: Any, reaches: Any, tops: Any) -> None:
    """The largest value of each line outside of what belongs to its peak, into `tops` (LANES,)."""
    # A loop of its own: within the caller's, the compiler does not get it into the vector unit.
    for j in range(size):
        tops[j] = largest_outside(seen[first + j], places[j] - reaches[j], places[j] + reaches[j])


@compiled
def _take(place: int, window: Any, s: Any, j: int, line: Any) -> None:
    """Start values from the sums of lane `j` into line (CANDIDATES, START)."""
    background = s[_BACKGROUND, j]
    line[0, CENTRE] = place - SEARCH + s[_MOMENT, j] / s[_OVER, j]
    line[0, WIDTH] = width_of(s[_ABOVE, j])
    line[0, HEIGHT] = window[SEARCH, j] - background
    line[0, BACKGROUND] = background
    line[0, ENERGY] = max(s[_TOTAL, j] - np.float32(PIXELS) * background, 1e-6)
    line[0, CORE] = 0.0


@compiled
def find_lines(image: Any, seen: Any, dark: Any, saturation: int, least_peak: float, start: Any) -> bool:
    """Start values of the lines of `image` (lines, n) into `start` (lines, CANDIDATES, START), which is 0 before.

    `dark` has one pixel where there is no dark frame, `seen` is what lies above it. The brightest peak comes first;
    where it is none (bright scenery), the one that stands out most. Of two peaks the one with more energy stays first;
    True when any line has two.
    """
    n = image.shape[1]
    line, rises = np.empty(n, np.float32), np.empty(n, np.uint8)
    window, sums = np.zeros((PIXELS, LANES), np.float32), np.zeros((_SUMS, LANES), np.float32)
    places, reaches = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    tops, beside = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    guess, several = 0, False
    for first in range(0, len(image), LANES):
        size = min(LANES, len(image) - first)
        for j in range(size):
            row = seen[first + j]
            top = tops[j] = largest(row)
            if top >= least_peak:
                places[j] = guess = _near(row, guess, top)
                if SEARCH <= guess < n - SEARCH:
                    _copy_window(image, dark, first + j, guess - SEARCH, j, window)
        _sum_windows(window, sums)
        for j in range(size):
            reaches[j] = reach_of(width_of(sums[_ABOVE, j]), 0)
        _largest_beside(seen, first, size, places, reaches, beside)
        for j in range(size):
            r, place = first + j, places[j]
            if tops[j] < least_peak:
                continue
            background = sums[_BACKGROUND, j]
            limit = rival_limit(background, window[SEARCH, j] - background, least_peak)
            inside = SEARCH <= place < n - SEARCH and image[r, place] < saturation
            if inside and sums[_RISE, j] >= least_peak and beside[j] < limit:
                _take(place, window, sums, j, start[r])
            elif find_line(image, seen, dark, r, saturation, least_peak, line, rises, start):
                several = True
    return several
