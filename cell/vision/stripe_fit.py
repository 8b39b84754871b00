"""The likeliest centre of the stripe in each line: the compiled maximum likelihood fit (theory sheet, part 3).

Fisher scoring on centre, amplitude, width and linear background, `LANES` lines at a time; one step is in
`stripe_lanes.py`. `stripe_numpy.py` says the same without a compiler.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.compiled import compiled, compiled_fast
from cell.vision import stripe_lanes as lane
from cell.vision.stripe_find import BACKGROUND, CENTRE, CORE, HEIGHT
from cell.vision.stripe_lanes import HALF, LANES, MIDDLE, ROWS

# Rows of the result. SIGMA is the centre's standard deviation with the noise as it is correlated, FISHER without.
FIT_CENTRE, SIGMA, AMPLITUDE, WIDTH, LEVEL, SLOPE, CHI2, FISHER = range(8)
FITTED = 8
PARAMETERS = 5
# Standard deviation of the prior on the logarithm of the width: from the count of pixels, and that of a clipped peak.
WIDTH_PRIOR, CLIPPED_PRIOR = 0.25, 0.7
# Centres half way between two pixels are common in whole numbers: both engines are to go to the same side.
NEAREST = 0.499


@compiled
def _begin(s: Any, j: int, best: Any, width: float, log_width: float) -> tuple[int, int]:
    """Start of lane `j` from a peak of `find_lines`; its origin and how far the fit looks from there, in px."""
    core = best[CORE]
    clipped = core > 1
    origin = int(np.floor(best[CENTRE] + NEAREST))
    prior = CLIPPED_PRIOR if clipped else WIDTH_PRIOR
    s[lane.CENTRE + j] = best[CENTRE] - origin
    s[lane.AMPLITUDE + j] = best[HEIGHT] * (np.exp(min(4.0, 0.5 * (0.5 * core / width) ** 2)) if clipped else 1.0)
    s[lane.LOG_WIDTH + j] = s[lane.EXPECTED + j] = log_width
    s[lane.LEVEL + j] = best[BACKGROUND]
    s[lane.SLOPE + j] = 0.0
    s[lane.PRIOR + j] = 1.0 / (prior * prior)
    s[lane.ACTIVE + j] = 1.0
    return origin, int(min(float(HALF), 0.5 * core + 4.0 * width + 3.0))


@compiled
def _gather(row: Any, origin: int, half: int, j: int, into: Any) -> None:
    """The pixels −half − 1 … half of a line around `origin` into a lane; the line's ends are repeated outside."""
    n = len(row)
    first, k = origin - half - 1, MIDDLE - half - 1
    if first >= 0 and origin + half < n:
        part, lane_pixels = row[first : first + 2 * half + 2], into[k : k + 2 * half + 2, j]
        for i in range(len(part)):
            lane_pixels[i] = part[i]
    else:
        for i in range(2 * half + 2):
            into[k + i, j] = row[min(max(first + i, 0), n - 1)]


@compiled_fast
def _weigh(
    raw: Any,
    shade: Any,
    reach: Any,
    half: int,
    saturation: float,
    dark_noise: Any,
    values: Any,
    variance: Any,
    used: Any,
) -> None:
    """Pixel values above the dark frame, their variance for it, and how many of each lane may be used.

    Others get a huge variance: the saturated ones, and those beyond `reach` (2, LANES) below and above the origin.
    """
    masked = np.float32(lane.MASKED)
    limit, constant, slope = np.float32(saturation), np.float32(dark_noise[0]), np.float32(dark_noise[1])
    for x in range(-half - 1, half + 1):
        k = MIDDLE + x
        place = np.float32(x)
        for j in range(LANES):
            value, below = np.float32(raw[k, j]), shade[k, j]
            usable = (value < limit) & (place >= reach[0, j]) & (place <= reach[1, j])
            values[k, j] = value - below
            variance[k, j] = constant + slope * below if usable else masked
            used[j] += np.float32(1.0) if usable else np.float32(0.0)


@compiled
def fit_lines(
    image: Any, dark: Any, start: Any, widths: Any, log_widths: Any, which: Any, saturation: int, noise: Any,
    dark_noise: Any, rho: Any, steps: int, out: Any,
) -> None:  # fmt: skip
    """Weighted maximum likelihood of the lines `which`: Fisher scoring on centre, amplitude, log width and background.

    `dark` has one line where there is none, `start` is from `find_lines`, `widths` (lines,) the expected σ in px,
    `log_widths` its logarithm. Variance of a pixel in DN²: noise[0] + noise[1] · value + (noise[2] · stripe)², of which
    the last is correlated by `rho` (LAGS,) at lags 1, 2, … (of no length: is not); a pixel of the dark frame adds
    dark_noise[0] + dark_noise[1] · dark. `out` (FITTED, lines); lines that cannot be fitted are left alone.
    """
    s = np.zeros(lane.NUMBERS, np.float32)
    raw = np.zeros((ROWS, LANES), np.uint8)
    shade = np.zeros((ROWS, LANES), np.float32)
    values, variance, moved = np.zeros_like(shade), np.zeros_like(shade), np.zeros_like(shade)
    reach = np.zeros((2, LANES), np.float32)
    used, fisher, fitted_width = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    origins, reaches = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    noise2, gain, contrast2 = np.float32(noise[0]), np.float32(noise[1]), np.float32(noise[2] * noise[2])
    for first in range(0, len(which), LANES):
        size = min(LANES, len(which) - first)
        half = 0
        for j in range(LANES):
            # Lanes to spare repeat the last line.
            r = which[first + min(j, size - 1)]
            origins[j], reaches[j] = _begin(s, j, start[r, 0], widths[r], log_widths[r])
            half = max(half, reaches[j])
            reach[0, j] = max(-reaches[j], -origins[j])
            reach[1, j] = min(reaches[j], image.shape[1] - 1 - origins[j])
            used[j] = 0.0
        for j in range(LANES):
            r = which[first + min(j, size - 1)]
            _gather(image[r], origins[j], half, j, raw)
            if len(dark) > 1:
                _gather(dark[r], origins[j], half, j, shade)
        _weigh(raw, shade, reach, half, saturation, dark_noise, values, variance, used)
        for _ in range(steps):
            lane.accumulate(s, values, variance, half, noise2, gain, contrast2)
            if lane.step_on(s) == 0.0:
                break
        for j in range(LANES):
            fisher[j] = s[lane.FISHER + j]
            fitted_width[j] = lane.exponential(s[lane.LOG_WIDTH + j])
        correlated = len(rho) > 0 and contrast2 > 0.0
        if correlated:
            lane.influence(s, variance, half, noise2, gain, contrast2, rho, moved)
        for j in range(size):
            if used[j] <= PARAMETERS or not s[lane.GOOD + j] > lane.SINGULAR:
                continue
            r = which[first + j]
            out[FIT_CENTRE, r] = origins[j] + s[lane.CENTRE + j]
            out[SIGMA, r] = np.sqrt(s[lane.VARIANCE + j] if correlated else fisher[j])
            out[AMPLITUDE, r] = s[lane.AMPLITUDE + j]
            out[WIDTH, r] = fitted_width[j]
            out[LEVEL, r] = s[lane.LEVEL + j]
            out[SLOPE, r] = s[lane.SLOPE + j] / lane.UNIT
            out[CHI2, r] = s[lane.MISFIT + j] / (used[j] - PARAMETERS)
            out[FISHER, r] = np.sqrt(fisher[j])
