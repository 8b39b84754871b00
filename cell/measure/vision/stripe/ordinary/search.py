"""Where the stripe is in each line of the picture: the lines are searched `LANES` at a time.

In nearly all lines the brightest pixel is the stripe's, near where the line before has it, and nothing else stands
out. These are measured side by side in the processor's vector unit; any other is left to `stripe_find.find_line`,
which would say the same of them.
"""

from __future__ import annotations

import numpy as np

from cell.base.compiled import compiled, compiled_fast
from cell.measure.vision.stripe.ordinary.find import (
    BACKGROUND,
    CENTRE,
    CORE,
    CUT,
    ENERGY,
    HEIGHT,
    SEARCH,
    WIDTH,
    Array,
    Floats,
    Image,
    Shade,
    Whole,
    find_line,
    first_at,
    largest,
    largest_outside,
    rival_limit,
    width_of,
)
from cell.measure.vision.stripe.ordinary.lanes import LANES

PIXELS = 2 * SEARCH + 1
# What is noted of a line: its brightest pixel's place and value, the largest value outside of the window there, and
# whether it takes more to say where its stripe is.
_PLACE, _TOP, _OUTSIDE, _OPEN = range(4)
_NOTES = 4
# Rows of the sums of a window: its background, what half of the peak and a fifth of it reach, how far the peak stands
# above the higher side; sums of the values, of what lies above a fifth and its moment; pixels above half; the largest
# value beside the peak.
_BACKGROUND, _HALF, _FIFTH, _RISE, _TOTAL, _OVER, _MOMENT, _ABOVE, _BESIDE = range(9)
_SUMS = 9


@compiled_fast
def _sum_windows(window: Floats, s: Floats) -> None:
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


@compiled_fast
def _look_beside(window: Floats, s: Floats) -> None:
    """The largest value of each window outside of what belongs to its peak, which is `reach_of` its width."""
    zero, one, four = np.float32(0.0), np.float32(1.0), np.float32(4.0)
    share = np.float32(4.0 / 2.355)
    for j in range(LANES):
        s[_BESIDE, j] = zero
    for i in range(PIXELS):
        away = np.float32(abs(i - SEARCH))
        for j in range(LANES):
            value = window[i, j] if away >= max(four, share * s[_ABOVE, j]) + one else zero
            s[_BESIDE, j] = max(s[_BESIDE, j], value)


@compiled
def _near(seen: Image, r: int, guess: int, top: int) -> int:
    """Where line `r` first reaches `top` within SEARCH of a guess, else where it does at all."""
    for i in range(max(0, guess - SEARCH), min(seen.shape[1], guess + SEARCH + 1)):
        if seen[r, i] >= top:
            return i
    return int(first_at(seen, r, top))


@compiled_fast
def _note_brightest(seen: Image, first: int, size: int, least_peak: float, notes: Whole) -> None:
    """Where the lines `first` on are brightest, and the largest value farther than SEARCH from there, into `notes`.

    A line is read once where its brightest pixel is near that of the line before. Of a line that does not reach
    `least_peak` only the value is true.
    """
    n = seen.shape[1]
    guess = notes[_PLACE, LANES - 1]
    for j in range(size):
        r = first + j
        place, top, outside = guess, 0, 0
        if SEARCH <= guess < n - SEARCH:
            outside = largest_outside(seen, r, guess - SEARCH, guess + SEARCH)
            for i in range(guess - SEARCH, guess + SEARCH + 1):
                if seen[r, i] > top:
                    place, top = i, int(seen[r, i])
        if top > outside:
            # What the window around the place does not reach any more is outside, too.
            for i in range(guess - SEARCH, place - SEARCH):
                outside = max(outside, int(seen[r, i]))
            for i in range(place + SEARCH + 1, guess + SEARCH + 1):
                outside = max(outside, int(seen[r, i]))
        else:
            top = largest(seen, r, 0, n)
            if top >= least_peak:
                place = _near(seen, r, guess, top)
                outside = largest_outside(seen, r, place - SEARCH, place + SEARCH)
        if top >= least_peak:
            guess = place
        notes[_PLACE, j], notes[_TOP, j], notes[_OUTSIDE, j] = guess, top, outside


@compiled_fast
def _keep(
    image: Image, dark: Shade, first: int, size: int, notes: Whole, window: Floats, cut: Image, cut_at: Whole
) -> None:
    """The pixels around the lines' noted places: above the dark frame into `window` (PIXELS, LANES), raw into `cut`."""
    n = image.shape[1]
    for j in range(size):
        r, place = first + j, notes[_PLACE, j]
        if n >= CUT:
            begin = np.uint64(min(max(place - CUT // 2, 0), n - CUT))
            cut_at[r] = begin
            # Of a count that it knows beforehand the compiler makes single steps.
            for i in range(np.uint64(0), np.uint64(cut.shape[1])):
                cut[r, i] = image[r, begin + i]
        low = place - SEARCH
        if low >= 0 and low + PIXELS <= n:
            for i in range(PIXELS):
                window[i, j] = image[r, low + i]
            if len(dark) > 1:
                for i in range(PIXELS):
                    window[i, j] -= dark[r, low + i]


@compiled
def _take(
    image: Image, first: int, size: int, saturation: int, least_peak: float, notes: Whole, window: Floats,
    s: Floats, start: Array,
) -> None:  # fmt: skip
    """Start values of the ordinary lines among the lanes, from their sums; the others are noted as open."""
    n = image.shape[1]
    for j in range(size):
        r, place = first + j, notes[_PLACE, j]
        background, height = s[_BACKGROUND, j], window[SEARCH, j] - s[_BACKGROUND, j]
        # What lies above the dark frame is rounded elsewhere: near the limit, a line is looked at more closely.
        beside = max(float(notes[_OUTSIDE, j]), s[_BESIDE, j] + 0.5)
        alone = beside < rival_limit(background, height, least_peak) and s[_RISE, j] >= least_peak
        inside = SEARCH <= place < n - SEARCH and image[r, place] < saturation
        bright = notes[_TOP, j] >= least_peak
        notes[_OPEN, j] = bright and not (alone and inside)
        if bright and alone and inside:
            start[r, 0, CENTRE] = place - SEARCH + s[_MOMENT, j] / s[_OVER, j]
            start[r, 0, WIDTH] = width_of(s[_ABOVE, j])
            start[r, 0, HEIGHT] = height
            start[r, 0, BACKGROUND] = background
            start[r, 0, ENERGY] = max(s[_TOTAL, j] - np.float32(PIXELS) * background, 1e-6)
            start[r, 0, CORE] = 0.0


@compiled
def find_lines(
    image: Image, seen: Image, dark: Shade, saturation: int, least_peak: float, start: Array, cut: Image,
    cut_at: Whole,
) -> bool:  # fmt: skip
    """Start values of the lines of `image` (lines, n) into `start` (lines, CANDIDATES, START), which is 0 before.

    `dark` has one pixel where there is no dark frame, `seen` is what lies above it. The brightest peak comes first;
    where it is none (bright scenery), the one that stands out most. Of two peaks the one with more energy stays first;
    True when any line has two. The pixels around a line's brightest are kept for the fit in `cut` (lines, CUT), from
    pixel `cut_at` (lines,) on, which is NOWHERE before.
    """
    line, rises = np.empty(image.shape[1], np.float32), np.empty(image.shape[1], np.uint8)
    window, sums = np.zeros((PIXELS, LANES), np.float32), np.zeros((_SUMS, LANES), np.float32)
    notes = np.zeros((_NOTES, LANES), np.int64)
    several = False
    for first in range(0, len(image), LANES):
        size = min(LANES, len(image) - first)
        _note_brightest(seen, first, size, least_peak, notes)
        _keep(image, dark, first, size=size, notes=notes, window=window, cut=cut, cut_at=cut_at)
        _sum_windows(window, sums)
        _look_beside(window, sums)
        _take(image, first, size, saturation, least_peak=least_peak, notes=notes, window=window, s=sums, start=start)
        for j in range(size):
            if notes[_OPEN, j]:
                found_two = find_line(
                    image,
                    seen,
                    dark,
                    r=first + j,
                    saturation=saturation,
                    least_peak=least_peak,
                    window=line,
                    rises=rises,
                    start=start,
                )
                several = several or found_two
    return several
