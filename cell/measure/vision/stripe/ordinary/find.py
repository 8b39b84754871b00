"""Where the stripe is in each line of the picture: the compiled search for its peaks, and their start values.

A line is an image row, or a column for stripes along columns. In nearly all lines the brightest pixel is the stripe's,
near where the line before has it, and nothing else stands out: these are measured `LANES` at a time in the processor's
vector unit. `find_line` takes any other, and would say the same of them.

Loops that run for every line take the whole picture and the line's number: a view of the line is counted as a reference
by the compiler, which costs as much as the loop. Unsigned indices save the question whether they count from the end.
"""

import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled, compiled_fast

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Whole = NDArray[np.int64]
Image = NDArray[np.uint8]
Shade = Image | Floats
"""A picture without the laser; of one pixel where there is none."""

LANES = 32
# Start values of a candidate: start[line, candidate, …]; an energy of 0 says that there is none.
CENTRE, WIDTH, HEIGHT, BACKGROUND, ENERGY, CORE = range(6)
START = 6
CANDIDATES = 2

BLOCK = 128
SEARCH = 12
# Pixels around a line's brightest one that are kept for the fit, which finds the line itself no longer near.
CUT = 64
NOWHERE = -(10**6)
# What is elsewhere in the line competes for being the stripe from this share of the first peak's height on.
RIVAL = 0.15
TRIES = 3
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
def largest(picture: Image, r: int, low: int, high: int) -> int:
    """Largest value of the pixels low … high − 1 of line `r`, 0 when there are none."""
    top = np.uint8(0)
    for i in range(np.uint64(low), np.uint64(max(low, high))):
        top = picture[r, i] if picture[r, i] > top else top
    return int(top)


@compiled_fast
def largest_outside(picture: Image, r: int, low: int, high: int) -> int:
    """Largest value of line `r` outside of low … high."""
    n = picture.shape[1]
    return int(max(largest(picture, r, 0, low), largest(picture, r, min(n, high + 1), n)))


@compiled
def first_at(picture: Image, r: int, top: int) -> int:
    """Where line `r` first reaches its largest value `top`: block by block, for a block's maximum is quickly had."""
    begin = 0
    while begin + BLOCK < picture.shape[1] and largest(picture, r, begin, begin + BLOCK) < top:
        begin += BLOCK
    while picture[r, begin] < top:
        begin += 1
    return begin


@compiled_fast
def _rises(row: Image, begin: int, end: int, rises: Image) -> int:
    """How far each pixel of row[begin:end] stands above both its neighbours at ±SEARCH, into `rises`; the largest."""
    size = end - begin
    if size <= 0:
        return 0
    # Views and 8-bit numbers, for loops that the vector unit takes.
    here, left, right = row[begin:end], row[begin - SEARCH : end - SEARCH], row[begin + SEARCH : end + SEARCH]
    for i in range(size):
        beside = left[i] if left[i] > right[i] else right[i]
        rises[i] = here[i] - beside if here[i] > beside else 0
    top = 0
    for i in range(size):
        top = max(top, int(rises[i]))
    return top


@compiled_fast
def _prominent(row: Image, low: int, high: int, rises: Image) -> int:
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
def width_of(above: float | np.float32) -> float:
    """The stripe's σ in px, of which this many pixels lie above half of the peak."""
    return max(float(above), 1.0) / 2.355


@compiled_fast
def _measure(
    image: Image, dark: Shade, r: int, place: int, saturation: int, least_peak: float, window: Floats, start: Array,
    k: int | np.intp,
) -> bool:  # fmt: skip
    """Start values of the peak at `place` in line `r` into start[r, k]; False when it does not stand `least_peak` above
    both its sides. Without views of the arrays, whose bookkeeping would cost as much as the sums."""
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
        width = width_of(above)
    start[r, k, CENTRE] = low + moment / energy
    start[r, k, WIDTH] = width
    start[r, k, HEIGHT] = peak - background
    start[r, k, BACKGROUND] = background
    start[r, k, ENERGY] = max(float(total), 1e-6)
    start[r, k, CORE] = core
    return True


@compiled
def reach_of(width: float, core: int) -> int:
    """How far from its peak, in px, a line still belongs to a stripe of this width."""
    return int(max(4.0, 4.0 * width)) + 1 + core


@compiled
def rival_limit(background: float, height: float, least_peak: float) -> float:
    """What competes with a peak for being the stripe reaches this value."""
    return float(background + max(least_peak, RIVAL * height))


@compiled
def find_line(
    image: Image, seen: Image, dark: Shade, r: int, saturation: int, least_peak: float, window: Floats,
    rises: Image, start: Array,
) -> bool:  # fmt: skip
    """Start values of line `r` into start[r] (CANDIDATES, START), which is 0 before, as `find_lines` says. True when it
    has two peaks. `window` (n,) and `rises` (n,) are overwritten."""
    row = seen[r]
    top = largest(seen, r, 0, len(row))
    if top < least_peak:
        return False
    place = first_at(seen, r, top)
    # As written, 0 and 1 would be two types, and each compiled by itself.
    first, second = np.intp(0), np.intp(1)
    found = _measure(image, dark, r, place, saturation, least_peak=least_peak, window=window, start=start, k=first)
    low = high = place
    for _ in range(TRIES - 1):
        if found:
            break
        low, high = min(low, place - 4), max(high, place + 4)
        place = _prominent(row, low, high, rises)
        if place < 0:
            return False
        found = _measure(image, dark, r, place, saturation, least_peak=least_peak, window=window, start=start, k=first)
    if not found:
        return False
    reach = reach_of(start[r, 0, WIDTH], int(start[r, 0, CORE]))
    low, high = place - reach, place + reach
    if largest_outside(seen, r, low, high) < rival_limit(start[r, 0, BACKGROUND], start[r, 0, HEIGHT], least_peak):
        return False
    place = _prominent(row, low, high, rises)
    if place < 0 or not _measure(
        image, dark, r, place=place, saturation=saturation, least_peak=least_peak, window=window, start=start, k=second
    ):
        return False
    if start[r, 1, ENERGY] > start[r, 0, ENERGY]:
        for k in range(START):
            start[r, 0, k], start[r, 1, k] = start[r, 1, k], start[r, 0, k]
    return True


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
                    image, seen, dark, r=first + j, saturation=saturation, least_peak=least_peak, window=line,
                    rises=rises, start=start,
                )  # fmt: skip
                several = several or found_two
    return several
