"""The likeliest centre of the stripe in each line: the compiled maximum likelihood fit (docs/explanation/theory.md,
section 5).

Fisher scoring on centre, amplitude, width and linear background, `LANES` lines at a time; one step is in
`lanes.py`.
"""

from __future__ import annotations

import numpy as np

from cell.base.compiled import compiled, compiled_fast
from cell.measure.vision.stripe.ordinary import lanes as lane
from cell.measure.vision.stripe.ordinary.find import BACKGROUND, CENTRE, CORE, CUT, HEIGHT, Array, Image, Shade, Whole
from cell.measure.vision.stripe.ordinary.lanes import HALF, LANES, MIDDLE, ROWS, Floats

# Rows of the result. SIGMA is the centre's standard deviation with the noise as it is correlated, FISHER without.
FIT_CENTRE, SIGMA, AMPLITUDE, WIDTH, LEVEL, SLOPE, CHI2, FISHER = range(8)
FITTED = 8
PARAMETERS = 5
# Standard deviation of the prior on the logarithm of the width: from the count of pixels, and that of a clipped peak.
WIDTH_PRIOR, CLIPPED_PRIOR = 0.25, 0.7
# Centres half way between two pixels are common in whole numbers: rounding is not to decide on the side.
NEAREST = 0.499


@compiled
def _begin(s: Floats, start: Array, widths: Array, log_widths: Array, lines: Whole, n: int, origins: Whole) -> int:
    """Starts of the lanes from their `lines`' peaks in `find_lines`, and their origins (LANES,).

    Returns how far from its origin, in px, the lane looks that looks farthest.
    """
    farthest = 0
    for j in range(LANES):
        r = lines[j]
        width, core, centre = widths[r], start[r, 0, CORE], start[r, 0, CENTRE]
        clipped = core > 1
        origin = origins[j] = int(np.floor(centre + NEAREST))
        prior = CLIPPED_PRIOR if clipped else WIDTH_PRIOR
        rise = np.exp(min(4.0, 0.5 * (0.5 * core / width) ** 2)) if clipped else 1.0
        s[lane.CENTRE + j] = centre - origin
        s[lane.AMPLITUDE + j] = start[r, 0, HEIGHT] * rise
        s[lane.LOG_WIDTH + j] = s[lane.EXPECTED + j] = log_widths[r]
        s[lane.LEVEL + j] = start[r, 0, BACKGROUND]
        s[lane.SLOPE + j] = 0.0
        s[lane.PRIOR + j] = 1.0 / (prior * prior)
        s[lane.ACTIVE + j] = 1.0
        s[lane.USED + j] = 0.0
        reach = int(min(float(HALF), 0.5 * core + 4.0 * width + 3.0))
        s[lane.LOW + j], s[lane.HIGH + j] = max(-reach, -origin), min(reach, n - 1 - origin)
        farthest = max(farthest, reach)
    return farthest


@compiled
def _gather(picture: Shade, lines: Whole, origins: Whole, half: int, into: Floats) -> None:
    """The pixels −half − 1 … half around the origins of the lanes' `lines`; a line's ends are repeated outside."""
    n, size, k = picture.shape[1], 2 * half + 2, MIDDLE - half - 1
    for j in range(LANES):
        r, first = lines[j], origins[j] - half - 1
        if first >= 0 and first + size <= n:
            for i in range(size):
                into[k + i, j] = picture[r, first + i]
        else:
            for i in range(size):
                into[k + i, j] = picture[r, min(max(first + i, 0), n - 1)]


@compiled_fast
def _weigh(s: Floats, half: int, saturation: float, values: Floats, variance: Floats) -> None:
    """A huge variance for what is not to be used, saturated pixels and those beyond a lane's reach; 0 for the others,
    which are counted."""
    masked, zero, one, limit = np.float32(lane.MASKED), np.float32(0.0), np.float32(1.0), np.float32(saturation)
    for x in range(-half - 1, half + 1):
        k = MIDDLE + x
        place = np.float32(x)
        for j in range(LANES):
            usable = (values[k, j] < limit) & (place >= s[lane.LOW + j]) & (place <= s[lane.HIGH + j])
            variance[k, j] = zero if usable else masked
            s[lane.USED + j] += one if usable else zero


@compiled_fast
def _darken(shade: Floats, half: int, dark_noise: tuple[float, float], values: Floats, variance: Floats) -> None:
    """Take the dark frame's pixels off, and add their variance."""
    constant, slope = np.float32(dark_noise[0]), np.float32(dark_noise[1])
    for k in range(MIDDLE - half - 1, MIDDLE + half + 1):
        for j in range(LANES):
            values[k, j] -= shade[k, j]
            variance[k, j] += constant + slope * shade[k, j]


@compiled
def fit_lines(
    image: Image, cut: Image, cut_at: Whole, dark: Shade, start: Array, widths: Array, log_widths: Array,
    which: Whole, saturation: int, noise: tuple[float, float, float], dark_noise: tuple[float, float], rho: Floats,
    steps: int, out: Array,
) -> None:  # fmt: skip
    """Weighted maximum likelihood of the lines `which`: Fisher scoring on centre, amplitude, log width and background.

    `cut`, `cut_at` and `start` are from `find_lines`, `dark` has one line where there is none, `widths` (lines,) is the
    expected σ in px, `log_widths` its logarithm. Variance of a pixel in DN²: noise[0] + noise[1] · value + (noise[2] ·
    stripe)², of which the last is correlated by `rho` (LAGS,) at lags 1, 2, … (of no length: is not); a pixel of the
    dark frame adds dark_noise[0] + dark_noise[1] · dark. `out` (FITTED, lines); lines that cannot be fitted are left
    alone.
    """
    s = np.zeros(lane.NUMBERS, np.float32)
    values = np.zeros((ROWS, LANES), np.float32)
    variance, shade, moved = np.zeros_like(values), np.zeros_like(values), np.zeros_like(values)
    fisher, fitted_width = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    lines, origins, in_cut = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    noise2, gain, contrast2 = np.float32(noise[0]), np.float32(noise[1]), np.float32(noise[2] * noise[2])
    for first in range(0, len(which), LANES):
        size = min(LANES, len(which) - first)
        for j in range(LANES):
            # Lanes to spare repeat the last line.
            lines[j] = which[first + min(j, size - 1)]
        half = _begin(s, start, widths, log_widths=log_widths, lines=lines, n=image.shape[1], origins=origins)
        for j in range(LANES):
            in_cut[j] = origins[j] - cut_at[lines[j]]
        if in_cut.min() > half and in_cut.max() + half < CUT:
            _gather(cut, lines, in_cut, half, values)
        else:
            _gather(image, lines, origins, half, values)
        _weigh(s, half, saturation, values, variance)
        if len(dark) > 1:
            _gather(dark, lines, origins, half, shade)
            _darken(shade, half, dark_noise, values, variance)
        for _ in range(steps):
            lane.accumulate(s, values, variance, half=half, noise2=noise2, gain=gain, contrast2=contrast2)
            if lane.step_on(s) == 0.0:
                break
        for j in range(LANES):
            fisher[j] = s[lane.FISHER + j]
            fitted_width[j] = lane.exponential(s[lane.LOG_WIDTH + j])
        correlated = len(rho) > 0 and contrast2 > 0.0
        if correlated:
            lane.influence(s, variance, half, noise2=noise2, gain=gain, contrast2=contrast2, rho=rho, moved=moved)
        for j in range(size):
            used = s[lane.USED + j]
            if used <= PARAMETERS or not s[lane.GOOD + j] > lane.SINGULAR:
                continue
            r = lines[j]
            out[FIT_CENTRE, r] = origins[j] + s[lane.CENTRE + j]
            out[SIGMA, r] = np.sqrt(s[lane.VARIANCE + j] if correlated else fisher[j])
            out[AMPLITUDE, r] = s[lane.AMPLITUDE + j]
            out[WIDTH, r] = fitted_width[j]
            out[LEVEL, r] = s[lane.LEVEL + j]
            out[SLOPE, r] = s[lane.SLOPE + j] / lane.UNIT
            out[CHI2, r] = s[lane.MISFIT + j] / (used - PARAMETERS)
            out[FISHER, r] = np.sqrt(fisher[j])
