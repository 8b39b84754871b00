"""Where the stripe is in each line of the picture: the compiled search for peaks, and their start values.

A line is an image row, or a column for stripes along columns. Every pixel is read once, for the maxima of blocks; the
rest looks only at what stands out. `stripe_numpy.py` says the same without a compiler.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.compiled import compiled, compiled_fast

# Start values of a candidate: start[line, candidate, …]; an energy of 0 says that there is none.
CENTRE, WIDTH, HEIGHT, BACKGROUND, ENERGY, CORE = range(6)
START = 6
CANDIDATES = 2

BLOCK = 128
SEARCH = 12
# What is elsewhere in the line competes for being the stripe from this share of the first peak's height on.
RIVAL = 0.15
TRIES = 3


@compiled_fast
def _largest(row: Any) -> int:
    """Largest value of some pixels, 0 when there are none."""
    top = np.uint8(0)
    for i in range(len(row)):
        top = row[i] if row[i] > top else top
    return int(top)


@compiled_fast
def _first(row: Any, begin: int, top: int, marks: Any) -> int:
    """Where row[begin : begin + BLOCK] first reaches `top`; `marks` is overwritten."""
    part = row[begin : min(len(row), begin + BLOCK)]
    limit = np.uint8(top)
    for i in range(len(part)):
        marks[i] = BLOCK - i if part[i] >= limit else 0
    first: int = begin + BLOCK - _largest(marks[: len(part)])
    return first


@compiled_fast
def _reached_elsewhere(row: Any, tops: Any, low: int, high: int, limit: float) -> bool:
    """Whether a pixel outside low … high reaches `limit`: by the blocks' maxima, beside the window pixel by pixel."""
    n = len(row)
    for b in range(len(tops)):
        if tops[b] >= limit and ((b + 1) * BLOCK <= low or b * BLOCK > high):
            return True
    below = _largest(row[max(0, low - BLOCK) : max(0, low)])
    above = _largest(row[min(n, high + 1) : min(n, high + 1 + BLOCK)])
    return bool(max(below, above) >= limit)


@compiled_fast
def _rises(row: Any, begin: int, end: int, rises: Any) -> int:
    """How far each pixel of row[begin:end] stands above both its neighbours at ±SEARCH, into `rises`; the largest."""
    size = end - begin
    if size <= 0:
        return 0
    # Views and 8-bit numbers, for loops that the vector unit takes.
    here, left, right = row[begin:end], row[begin - SEARCH : end - SEARCH], row[begin + SEARCH : end + SEARCH]
    for i in range(size):
        beside = left[i] if left[i] > right[i] else right[i]
        rises[i] = here[i] - beside if here[i] > beside else 0
    top: int = _largest(rises[:size])
    return top


@compiled_fast
def _prominent(row: Any, low: int, high: int, rises: Any) -> int:
    """Where, outside low … high, a pixel stands farthest above its neighbours at ±SEARCH; −1 when none does."""
    n = len(row)
    best, place = 0, -1
    for side in range(2):
        begin = SEARCH if side == 0 else max(SEARCH, high + 1)
        end = min(n - SEARCH, low) if side == 0 else n - SEARCH
        rise = _rises(row, begin, end, rises)
        if rise > best:
            best = rise
            place = 0
            while rises[place] < best:
                place += 1
            place += begin
    return place


@compiled_fast
def _measure(
    image: Any, dark: Any, r: int, place: int, saturation: int, least_peak: float, window: Any, start: Any, k: int
) -> bool:
    """Start values of the peak at `place` in line `r` into start[r, k]; False when it does not stand `least_peak` above
    both its sides. Without views of the arrays, whose bookkeeping would cost as much as the sums.
    """
    n = image.shape[1]
    # A wide saturated core pushes the search window out, so that its ends still see the background.
    core_low, core_high = place, place
    core = 0
    if image[r, place] >= saturation:
        while core_low > 0 and image[r, core_low - 1] >= saturation:
            core_low -= 1
        while core_high < n - 1 and image[r, core_high + 1] >= saturation:
            core_high += 1
        core = core_high - core_low + 1
    low, high = max(0, core_low - SEARCH), min(n - 1, core_high + SEARCH)
    size = high - low + 1
    for i in range(size):
        window[i] = image[r, low + i]
    if len(dark) > 1:
        for i in range(size):
            window[i] -= dark[r, low + i]
    left = np.float32(0.25) * (window[0] + window[1] + window[2] + window[3])
    right = np.float32(0.25) * (window[size - 1] + window[size - 2] + window[size - 3] + window[size - 4])
    peak = window[place - low]
    if peak - max(left, right) < least_peak:
        return False
    background = np.float32(0.5) * (left + right)
    half = background + np.float32(0.5) * (peak - background)
    floor = background + np.float32(0.2) * (peak - background)
    zero, one = np.float32(0.0), np.float32(1.0)
    above, energy, moment, total = zero, zero, zero, zero
    for i in range(size):
        value = window[i]
        over = max(value - floor, zero)
        total += value - background
        energy += over
        moment += np.float32(i) * over
        above += one if value > half else zero
    if core > 1:
        # Gaussian flanks: the core is the width at saturation, `above` the width at half of the clipped height.
        width = (max(float(above * above - core * core), 2.0) / 5.545) ** 0.5
    else:
        width = max(float(above), 1.0) / 2.355
    start[r, k, CENTRE] = low + moment / energy
    start[r, k, WIDTH] = width
    start[r, k, HEIGHT] = peak - background
    start[r, k, BACKGROUND] = background
    start[r, k, ENERGY] = max(total, 1e-6)
    start[r, k, CORE] = core
    return True


@compiled
def find_lines(image: Any, seen: Any, dark: Any, saturation: int, least_peak: float, start: Any) -> None:
    """Start values of the lines of `image` (lines, n) into `start` (lines, CANDIDATES, START), which is 0 before.

    `dark` has one pixel where there is no dark frame, `seen` is what lies above it. The brightest peak comes first;
    where it is none (bright scenery), the one that stands out most. Of two peaks the one with more energy stays first.
    """
    n = image.shape[1]
    window = np.empty(n, np.float32)
    rises = np.empty(n + BLOCK, np.uint8)
    tops = np.empty((n + BLOCK - 1) // BLOCK, np.int64)
    for r in range(len(image)):
        row = seen[r]
        block = 0
        for b in range(len(tops)):
            tops[b] = _largest(row[b * BLOCK : min(n, (b + 1) * BLOCK)])
            block = b if tops[b] > tops[block] else block
        if tops[block] < least_peak:
            continue
        place = _first(row, block * BLOCK, tops[block], rises)
        found = _measure(image, dark, r, place, saturation, least_peak, window, start, 0)
        low = high = place
        for _ in range(TRIES - 1):
            if found:
                break
            low, high = min(low, place - 4), max(high, place + 4)
            place = _prominent(row, low, high, rises)
            if place < 0:
                break
            found = _measure(image, dark, r, place, saturation, least_peak, window, start, 0)
        if not found:
            continue
        reach = int(max(4.0, 4.0 * start[r, 0, WIDTH])) + 1 + int(start[r, 0, CORE])
        low, high = place - reach, place + reach
        limit = start[r, 0, BACKGROUND] + max(least_peak, RIVAL * start[r, 0, HEIGHT])
        if not _reached_elsewhere(row, tops, low, high, limit):
            continue
        place = _prominent(row, low, high, rises)
        if place < 0 or not _measure(image, dark, r, place, saturation, least_peak, window, start, 1):
            continue
        if start[r, 1, ENERGY] > start[r, 0, ENERGY]:
            for k in range(START):
                start[r, 0, k], start[r, 1, k] = start[r, 1, k], start[r, 0, k]
