"""The likeliest centre of the stripe in each line: the compiled maximum likelihood fit (theory sheet, part 3).

`LANES` lines are fitted side by side, so that the processor's vector unit does one pixel of all of them at once. The
numbers of a batch lie in one flat array, quantity by quantity. `stripe_numpy.py` says the same without a compiler.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.vision.compiled import compiled, compiled_fast
from cell.vision.stripe_find import BACKGROUND, CENTRE, CORE, HEIGHT

# Rows of the result. SIGMA is the centre's standard deviation with the noise as it is correlated, FISHER without.
FIT_CENTRE, SIGMA, AMPLITUDE, WIDTH, LEVEL, SLOPE, CHI2, FISHER = range(8)
FITTED = 8

LANES = 16
HALF = 60
PARAMETERS = 5
# The slope's unit in px, for numbers of like size in single precision.
UNIT = 8.0
MASKED = 1e20
LAGS = 6

# Standard deviation of the prior on the logarithm of the width: from the count of pixels, and that of a clipped peak.
WIDTH_PRIOR, CLIPPED_PRIOR = 0.25, 0.7
LARGEST_STEP, LARGEST_WIDTH_STEP = 1.5, 0.3
# A step this short, in px or in standard deviations of the centre, leaves an error far below the noise.
CONVERGED, CONVERGED_SIGMAS, CONVERGED_WIDTH = 0.05, 0.2, 0.1

# Offsets of the quantities in the flat array: first the 15 of the normal matrix by rows, then the right hand side.
_N = 0
_R = 15 * LANES
_CHI2, _C, _A, _W, _B, _S = (k * LANES for k in range(20, 26))
_INV, _G, _UP, _DOWN, _SHRINK = (k * LANES for k in range(26, 31))
_EXPECTED, _PRIOR, _ACTIVE, _GOOD = (k * LANES for k in range(31, 35))
_X = 36 * LANES
_U = 41 * LANES
_VAR = 46 * LANES
_PEAK = 48 * LANES
_ROW = 49 * LANES
_MISFIT = 54 * LANES
_SIZE = 55 * LANES


@compiled_fast
def _begin(s: Any) -> None:
    """Sums to 0; the Gaussian at x = 0 and its ratios to the next pixel both ways."""
    for k in range(_C):
        s[k] = np.float32(0.0)
    half = np.float32(0.5)
    for j in range(LANES):
        inverse = np.exp(-s[_W + j])
        z = -s[_C + j] * inverse
        shrink = np.exp(-half * inverse * inverse)
        up = np.exp(-inverse * z)
        s[_INV + j] = inverse
        s[_PEAK + j] = np.exp(-half * z * z)
        s[_UP + j] = up * shrink
        s[_DOWN + j] = shrink / up
        s[_SHRINK + j] = shrink * shrink


@compiled_fast
def _ahead(s: Any, ratio: Any, down: bool) -> None:
    """Set the Gaussian and its ratio to walk up from x = 0, or down from x = −1."""
    for j in range(LANES):
        if down:
            s[_G + j] = s[_PEAK + j] * s[_DOWN + j]
            ratio[j] = s[_DOWN + j] * s[_SHRINK + j]
        else:
            s[_G + j] = s[_PEAK + j]
            ratio[j] = s[_UP + j]


@compiled_fast
def _pixel(s: Any, value: Any, variance: Any, ratio: Any, x: Any, noise2: Any, gain: Any, contrast2: Any) -> None:
    """Add one pixel of every lane to the normal equations; then step the Gaussian on by its `ratio`."""
    zero = np.float32(0.0)
    xs = x * np.float32(1.0 / UNIT)
    for j in range(LANES):
        g = s[_G + j]
        inverse = s[_INV + j]
        z = (x - s[_C + j]) * inverse
        stripe = s[_A + j] * g
        mean = s[_B + j] + s[_S + j] * xs + stripe
        shot = gain * mean
        if shot < zero:
            shot = zero
        weight = np.float32(1.0) / (noise2 + shot + contrast2 * stripe * stripe + variance[j])
        residual = value[j] - mean
        j0 = stripe * z * inverse
        j2 = stripe * z * z
        w0 = weight * j0
        w1 = weight * g
        w2 = weight * j2
        w4 = weight * xs
        s[_N + j] += w0 * j0
        s[_N + 1 * LANES + j] += w1 * j0
        s[_N + 2 * LANES + j] += w1 * g
        s[_N + 3 * LANES + j] += w2 * j0
        s[_N + 4 * LANES + j] += w2 * g
        s[_N + 5 * LANES + j] += w2 * j2
        s[_N + 6 * LANES + j] += w0
        s[_N + 7 * LANES + j] += w1
        s[_N + 8 * LANES + j] += w2
        s[_N + 9 * LANES + j] += weight
        s[_N + 10 * LANES + j] += w4 * j0
        s[_N + 11 * LANES + j] += w4 * g
        s[_N + 12 * LANES + j] += w4 * j2
        s[_N + 13 * LANES + j] += w4
        s[_N + 14 * LANES + j] += w4 * xs
        s[_R + j] += w0 * residual
        s[_R + 1 * LANES + j] += w1 * residual
        s[_R + 2 * LANES + j] += w2 * residual
        s[_R + 3 * LANES + j] += weight * residual
        s[_R + 4 * LANES + j] += w4 * residual
        s[_CHI2 + j] += weight * residual * residual
        s[_G + j] = g * ratio[j]
        ratio[j] *= s[_SHRINK + j]


@compiled_fast
def _accumulate(s: Any, values: Any, variance: Any, half: int, noise2: Any, gain: Any, contrast2: Any) -> None:
    """The normal equations of all lanes over the pixels −half … half around their origins."""
    ratio = np.empty(LANES, np.float32)
    _begin(s)
    _ahead(s, ratio, False)
    for x in range(half + 1):
        k = HALF + x
        _pixel(s, values[k], variance[k], ratio, np.float32(x), noise2, gain, contrast2)
    _ahead(s, ratio, True)
    for x in range(1, half + 1):
        k = HALF - x
        _pixel(s, values[k], variance[k], ratio, np.float32(-x), noise2, gain, contrast2)


@compiled_fast
def _solve(s: Any) -> None:
    """Cholesky factor, the step in _X and the centre's row of the inverse in _U, for all lanes."""
    tiny = np.float32(1e-12)
    one = np.float32(1.0)
    for j in range(LANES):
        n22 = s[_N + 5 * LANES + j] + s[_PRIOR + j]
        r2 = s[_R + 2 * LANES + j] + s[_PRIOR + j] * (s[_EXPECTED + j] - s[_W + j])
        p0 = max(s[_N + j], tiny)
        i0 = one / np.sqrt(p0)
        a10, a20, a30, a40 = (
            s[_N + 1 * LANES + j] * i0,
            s[_N + 3 * LANES + j] * i0,
            s[_N + 6 * LANES + j] * i0,
            s[_N + 10 * LANES + j] * i0,
        )
        p1 = max(s[_N + 2 * LANES + j] - a10 * a10, tiny)
        i1 = one / np.sqrt(p1)
        a21 = (s[_N + 4 * LANES + j] - a20 * a10) * i1
        a31 = (s[_N + 7 * LANES + j] - a30 * a10) * i1
        a41 = (s[_N + 11 * LANES + j] - a40 * a10) * i1
        p2 = max(n22 - a20 * a20 - a21 * a21, tiny)
        i2 = one / np.sqrt(p2)
        a32 = (s[_N + 8 * LANES + j] - a30 * a20 - a31 * a21) * i2
        a42 = (s[_N + 12 * LANES + j] - a40 * a20 - a41 * a21) * i2
        p3 = max(s[_N + 9 * LANES + j] - a30 * a30 - a31 * a31 - a32 * a32, tiny)
        i3 = one / np.sqrt(p3)
        a43 = (s[_N + 13 * LANES + j] - a40 * a30 - a41 * a31 - a42 * a32) * i3
        p4 = max(s[_N + 14 * LANES + j] - a40 * a40 - a41 * a41 - a42 * a42 - a43 * a43, tiny)
        i4 = one / np.sqrt(p4)
        s[_GOOD + j] = min(p0, p1, p2, p3, p4)
        y0 = s[_R + j] * i0
        y1 = (s[_R + 1 * LANES + j] - a10 * y0) * i1
        y2 = (r2 - a20 * y0 - a21 * y1) * i2
        y3 = (s[_R + 3 * LANES + j] - a30 * y0 - a31 * y1 - a32 * y2) * i3
        y4 = (s[_R + 4 * LANES + j] - a40 * y0 - a41 * y1 - a42 * y2 - a43 * y3) * i4
        # The misfit that this step leaves, to second order.
        s[_CHI2 + j] -= y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3 + y4 * y4
        x4 = y4 * i4
        x3 = (y3 - a43 * x4) * i3
        x2 = (y2 - a42 * x4 - a32 * x3) * i2
        x1 = (y1 - a41 * x4 - a31 * x3 - a21 * x2) * i1
        s[_X + j] = (y0 - a40 * x4 - a30 * x3 - a20 * x2 - a10 * x1) * i0
        s[_X + 1 * LANES + j] = x1
        s[_X + 2 * LANES + j] = x2
        s[_X + 3 * LANES + j] = x3
        s[_X + 4 * LANES + j] = x4
        v0 = i0
        v1 = -a10 * v0 * i1
        v2 = -(a20 * v0 + a21 * v1) * i2
        v3 = -(a30 * v0 + a31 * v1 + a32 * v2) * i3
        v4 = -(a40 * v0 + a41 * v1 + a42 * v2 + a43 * v3) * i4
        u4 = v4 * i4
        u3 = (v3 - a43 * u4) * i3
        u2 = (v2 - a42 * u4 - a32 * u3) * i2
        u1 = (v1 - a41 * u4 - a31 * u3 - a21 * u2) * i1
        s[_U + j] = (v0 - a40 * u4 - a30 * u3 - a20 * u2 - a10 * u1) * i0
        s[_U + 1 * LANES + j] = u1
        s[_U + 2 * LANES + j] = u2
        s[_U + 3 * LANES + j] = u3
        s[_U + 4 * LANES + j] = u4


@compiled_fast
def _step(s: Any) -> float:
    """Take the step in the lanes that go on; how many of them are not done yet."""
    left = np.float32(0.0)
    third, three = np.float32(0.3), np.float32(3.0)
    largest, widest = np.float32(LARGEST_STEP), np.float32(LARGEST_WIDTH_STEP)
    for j in range(LANES):
        active = s[_ACTIVE + j]
        centre, width = s[_X + j], s[_X + 2 * LANES + j]
        amplitude = s[_A + j]
        changed = min(max(amplitude + s[_X + 1 * LANES + j], third * amplitude), three * amplitude)
        s[_A + j] = amplitude + active * (changed - amplitude)
        s[_C + j] += active * min(max(centre, -largest), largest)
        s[_W + j] += active * min(max(width, -widest), widest)
        s[_B + j] += active * s[_X + 3 * LANES + j]
        s[_S + j] += active * s[_X + 4 * LANES + j]
        s[_ROW + j] += active * (s[_U + j] - s[_ROW + j])
        s[_ROW + 1 * LANES + j] += active * (s[_U + 1 * LANES + j] - s[_ROW + 1 * LANES + j])
        s[_ROW + 2 * LANES + j] += active * (s[_U + 2 * LANES + j] - s[_ROW + 2 * LANES + j])
        s[_ROW + 3 * LANES + j] += active * (s[_U + 3 * LANES + j] - s[_ROW + 3 * LANES + j])
        s[_ROW + 4 * LANES + j] += active * (s[_U + 4 * LANES + j] - s[_ROW + 4 * LANES + j])
        s[_MISFIT + j] += active * (s[_CHI2 + j] - s[_MISFIT + j])
        short = max(np.float32(CONVERGED**2), np.float32(CONVERGED_SIGMAS**2) * s[_U + j])
        done = (centre * centre < short) and (abs(width) < np.float32(CONVERGED_WIDTH))
        s[_ACTIVE + j] = np.float32(0.0) if done else active
        left += s[_ACTIVE + j]
    return float(left)


@compiled_fast
def _influence(
    s: Any, variance: Any, half: int, noise2: Any, gain: Any, contrast2: Any, lags: int, rho: Any, moved: Any
) -> None:
    """Variance of the centre in _VAR for noise whose speckle part is correlated by `rho` at lags 1, 2, …

    The influence of a pixel on the centre is its weight times the centre's row of the inverse times its derivatives.
    """
    ratio = np.empty(LANES, np.float32)
    _begin(s)
    for j in range(LANES):
        # The width's prior is one more datum.
        s[_VAR + j] = s[_ROW + 2 * LANES + j] * s[_ROW + 2 * LANES + j] * s[_PRIOR + j]
    _ahead(s, ratio, False)
    for x in range(half + 1):
        k = HALF + x
        _pull(s, variance[k], moved[k], ratio, np.float32(x), noise2, gain, contrast2)
    _ahead(s, ratio, True)
    for x in range(1, half + 1):
        k = HALF - x
        _pull(s, variance[k], moved[k], ratio, np.float32(-x), noise2, gain, contrast2)
    for lag in range(1, lags + 1):
        both = np.float32(2.0) * contrast2 * rho[lag - 1]
        for k in range(HALF - half, HALF + half + 1 - lag):
            _multiply(s, moved[k], moved[k + lag], both)


@compiled_fast
def _pull(s: Any, variance: Any, moved: Any, ratio: Any, x: Any, noise2: Any, gain: Any, contrast2: Any) -> None:
    """Add one pixel's share of the centre's variance; `moved` is how far speckle of contrast 1 there moves it."""
    zero = np.float32(0.0)
    xs = x * np.float32(1.0 / UNIT)
    for j in range(LANES):
        g = s[_G + j]
        z = (x - s[_C + j]) * s[_INV + j]
        stripe = s[_A + j] * g
        shot = gain * (s[_B + j] + s[_S + j] * xs + stripe)
        if shot < zero:
            shot = zero
        weight = np.float32(1.0) / (noise2 + shot + contrast2 * stripe * stripe + variance[j])
        share = stripe * z * (s[_ROW + j] * s[_INV + j] + s[_ROW + 2 * LANES + j] * z)
        share += s[_ROW + 1 * LANES + j] * g + s[_ROW + 3 * LANES + j] + s[_ROW + 4 * LANES + j] * xs
        s[_VAR + j] += weight * share * share
        moved[j] = weight * share * stripe
        s[_G + j] = g * ratio[j]
        ratio[j] *= s[_SHRINK + j]


@compiled_fast
def _multiply(s: Any, one: Any, other: Any, factor: Any) -> None:
    for j in range(LANES):
        s[_VAR + j] += factor * one[j] * other[j]


@compiled
def _load(
    row: Any,
    dark: Any,
    with_dark: bool,
    lane: int,
    origin: int,
    reach: int,
    half: int,
    saturation: int,
    dark_noise2: float,
    dark_gain: float,
    values: Any,
    variance: Any,
) -> int:
    """One line's pixels around `origin` into a lane; the number that may be used. Others get a huge variance."""
    n = len(row)
    used = 0
    for x in range(-half, half + 1):
        k = HALF + x
        i = origin + x
        if i < 0 or i >= n or x < -reach or x > reach or row[i] >= saturation:
            values[k, lane] = np.float32(0.0)
            variance[k, lane] = np.float32(MASKED)
            continue
        used += 1
        if with_dark:
            values[k, lane] = np.float32(row[i]) - np.float32(dark[i])
            variance[k, lane] = np.float32(dark_noise2 + dark_gain * dark[i])
        else:
            values[k, lane] = np.float32(row[i])
            variance[k, lane] = np.float32(0.0)
    return used


@compiled
def fit_lines(
    image: Any,
    dark: Any,
    with_dark: bool,
    start: Any,
    widths: Any,
    which: Any,
    saturation: int,
    noise2: float,
    gain: float,
    contrast: float,
    rho: Any,
    dark_noise2: float,
    dark_gain: float,
    steps: int,
    out: Any,
) -> None:
    """Weighted maximum likelihood of the lines `which`: Fisher scoring on centre, amplitude, log width and background.

    `start` is from `find_lines`, `widths` (lines,) the expected σ in px. Variance of a pixel in DN²: noise2 + gain ·
    value + (contrast · stripe)², of which the last is correlated by `rho` (m,) at lags 1 … m; a pixel of the dark frame
    adds dark_noise2 + dark_gain · dark. `out` (FITTED, lines); lines that cannot be fitted are left alone.
    """
    s = np.zeros(_SIZE, np.float32)
    values = np.zeros((2 * HALF + 1, LANES), np.float32)
    variance = np.full((2 * HALF + 1, LANES), np.float32(MASKED), np.float32)
    moved = np.zeros((2 * HALF + 1, LANES), np.float32)
    origins = np.zeros(LANES, np.int64)
    reaches = np.zeros(LANES, np.int64)
    used = np.zeros(LANES, np.int64)
    noise, slope, contrast2 = np.float32(noise2), np.float32(gain), np.float32(contrast * contrast)
    lags = min(len(rho), LAGS)
    for first in range(0, len(which), LANES):
        size = min(LANES, len(which) - first)
        half = 0
        for j in range(size):
            r = which[first + j]
            core = start[r, 0, CORE]
            origins[j] = int(np.floor(start[r, 0, CENTRE] + 0.5))
            reaches[j] = int(min(float(HALF), 0.5 * core + 4.0 * widths[r] + 3.0))
            half = max(half, reaches[j])
        for j in range(LANES):
            # Lanes to spare repeat the last line.
            lane = min(j, size - 1)
            r = which[first + lane]
            core = start[r, 0, CORE]
            clipped = core > 1
            expected = np.log(widths[r])
            amplitude = start[r, 0, HEIGHT]
            if clipped:
                amplitude *= np.exp(min(4.0, 0.5 * (0.5 * core / widths[r]) ** 2))
            s[_C + j] = start[r, 0, CENTRE] - origins[lane]
            s[_A + j] = amplitude
            s[_W + j] = expected
            s[_B + j] = start[r, 0, BACKGROUND]
            s[_S + j] = 0.0
            s[_EXPECTED + j] = expected
            s[_PRIOR + j] = 1.0 / (CLIPPED_PRIOR * CLIPPED_PRIOR) if clipped else 1.0 / (WIDTH_PRIOR * WIDTH_PRIOR)
            s[_ACTIVE + j] = 1.0
            s[_MISFIT + j] = 0.0
            for k in range(PARAMETERS):
                s[_ROW + k * LANES + j] = 0.0
            used[j] = _load(
                image[r],
                dark[r] if with_dark else dark[0],
                with_dark,
                j,
                origins[lane],
                reaches[lane],
                half,
                saturation,
                dark_noise2,
                dark_gain,
                values,
                variance,
            )
        for _ in range(steps):
            _accumulate(s, values, variance, half, noise, slope, contrast2)
            _solve(s)
            if _step(s) == 0.0:
                break
        if lags > 0 and contrast > 0.0:
            _influence(s, variance, half, noise, slope, contrast2, lags, rho, moved)
        else:
            for j in range(LANES):
                s[_VAR + j] = s[_ROW + j]
        for j in range(size):
            r = which[first + j]
            if used[j] <= PARAMETERS or not s[_GOOD + j] > 1e-12:
                continue
            out[FIT_CENTRE, r] = origins[j] + s[_C + j]
            out[SIGMA, r] = np.sqrt(s[_VAR + j])
            out[AMPLITUDE, r] = s[_A + j]
            out[WIDTH, r] = np.exp(s[_W + j])
            out[LEVEL, r] = s[_B + j]
            out[SLOPE, r] = s[_S + j] / UNIT
            out[CHI2, r] = s[_MISFIT + j] / (used[j] - PARAMETERS)
            out[FISHER, r] = np.sqrt(s[_ROW + j])
