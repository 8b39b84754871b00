"""Where the stripe is in each line of the picture: the compiled search for peaks, and their start values.

A line is an image row, or a column for stripes along columns. Every pixel is read once, for the maxima of blocks; the
rest looks only at what stands out. `stripe_numpy.py` says the same without a compiler.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.vision.compiled import compiled, compiled_fast

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
def _largest(row: Any, low: int, high: int) -> int:
    """Largest value of row[low:high], 0 when that is empty."""
    if low >= high:
        return 0
    part = row[low:high]
    top = part[0]
    for i in range(len(part)):
        if part[i] > top:
            top = part[i]
    return int(top)


@compiled_fast
def _elsewhere(row: Any, tops: Any, low: int, high: int) -> int:
    """Largest value of a line outside low … high, from the maxima of its blocks where they lie outside."""
    n = len(row)
    top = 0
    for b in range(len(tops)):
        begin, end = b * BLOCK, min(n, (b + 1) * BLOCK)
        if tops[b] <= top:
            continue
        if end <= low or begin > high:
            top = int(tops[b])
        else:
            top = max(top, _largest(row, begin, min(end, low)), _largest(row, max(begin, high + 1), end))
    return top


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
    top: int = _largest(rises, 0, size)
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


@compiled
def _measure(
    row: Any, dark: Any, with_dark: bool, place: int, saturation: int, least_peak: float, scratch: Any, out: Any
) -> bool:
    """Start values of the peak at `place`; False when it does not stand `least_peak` above both its sides."""
    n = len(row)
    # A wide saturated core pushes the search window out, so that its ends still see the background.
    core_low, core_high = place, place
    core = 0
    if row[place] >= saturation:
        while core_low > 0 and row[core_low - 1] >= saturation:
            core_low -= 1
        while core_high < n - 1 and row[core_high + 1] >= saturation:
            core_high += 1
        core = core_high - core_low + 1
    low, high = max(0, core_low - SEARCH), min(n - 1, core_high + SEARCH)
    size = high - low + 1
    for i in range(size):
        scratch[i] = row[low + i]
    if with_dark:
        for i in range(size):
            scratch[i] -= dark[low + i]
    left = 0.25 * (scratch[0] + scratch[1] + scratch[2] + scratch[3])
    right = 0.25 * (scratch[size - 1] + scratch[size - 2] + scratch[size - 3] + scratch[size - 4])
    peak = scratch[place - low]
    if peak - max(left, right) < least_peak:
        return False
    background = 0.5 * (left + right)
    _sums(scratch, size, low, background, peak, core, out)
    return True


@compiled_fast
def _sums(scratch: Any, size: int, low: int, background: float, peak: float, core: int, out: Any) -> None:
    """The box sum's centre and width of the window in `scratch`."""
    half = background + 0.5 * (peak - background)
    floor = background + 0.2 * (peak - background)
    above, energy, moment, total = 0.0, 0.0, 0.0, 0.0
    for i in range(size):
        value = scratch[i]
        over = max(value - floor, 0.0)
        total += value - background
        energy += over
        moment += i * over
        above += 1.0 if value > half else 0.0
    if core > 1:
        # Gaussian flanks: the core is the width at saturation, `above` the width at half of the clipped height.
        width = (max(above * above - core * core, 2.0) / 5.545) ** 0.5
    else:
        width = max(above, 1.0) / 2.355
    out[CENTRE] = low + moment / energy
    out[WIDTH] = width
    out[HEIGHT] = peak - background
    out[BACKGROUND] = background
    out[ENERGY] = max(total, 1e-6)
    out[CORE] = core


@compiled
def find_lines(
    image: Any,
    seen: Any,
    dark: Any,
    with_dark: bool,
    saturation: int,
    least_peak: float,
    first: int,
    last: int,
    start: Any,
) -> None:
    """Start values of the lines first … last − 1 of `image` (lines, n) into `start` (lines, CANDIDATES, START).

    `seen` is what lies above the dark frame. The brightest peak comes first; where it is none (bright scenery), the
    one that stands out most. Of two peaks the one with more energy stays first.
    """
    n = image.shape[1]
    scratch = np.empty(n, np.float64)
    rises = np.empty(n, np.uint8)
    tops = np.empty((n + BLOCK - 1) // BLOCK, np.int64)
    for r in range(first, last):
        start[r] = 0.0
        row = seen[r]
        block = 0
        for b in range(len(tops)):
            tops[b] = _largest(row, b * BLOCK, min(n, (b + 1) * BLOCK))
            if tops[b] > tops[block]:
                block = b
        if tops[block] < least_peak:
            continue
        place = block * BLOCK
        while row[place] < tops[block]:
            place += 1
        shade = dark[r] if with_dark else dark[0]
        best = start[r, 0]
        found = _measure(image[r], shade, with_dark, place, saturation, least_peak, scratch, best)
        low = high_end = place
        for _ in range(TRIES - 1):
            if found:
                break
            low, high_end = min(low, place - 4), max(high_end, place + 4)
            place = _prominent(row, low, high_end, rises)
            if place < 0:
                break
            found = _measure(image[r], shade, with_dark, place, saturation, least_peak, scratch, best)
        if not found:
            continue
        reach = int(max(4.0, 4.0 * best[WIDTH])) + 1 + int(best[CORE])
        low, high_end = place - reach, place + reach
        if _elsewhere(row, tops, low, high_end) < best[BACKGROUND] + max(least_peak, RIVAL * best[HEIGHT]):
            continue
        place = _prominent(row, low, high_end, rises)
        rival = start[r, 1]
        if place < 0 or not _measure(image[r], shade, with_dark, place, saturation, least_peak, scratch, rival):
            continue
        if rival[ENERGY] > best[ENERGY]:
            for k in range(START):
                best[k], rival[k] = rival[k], best[k]
