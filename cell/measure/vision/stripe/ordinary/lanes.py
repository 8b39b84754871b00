"""One step of the stripe's fit for `LANES` lines side by side: normal equations, their solution, the centre's variance.

The processor's vector unit does one pixel of all lanes at once; to that end the numbers of a batch lie in one flat
array, quantity by quantity, and loops over lanes hold nothing but arithmetic. With z = (x − centre) / width and g the
Gaussian, the model's derivatives are z g, g, z² g, 1 and z but for factors: so sums of five powers of z under g², four
under g and three under 1 are the whole normal matrix.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled_fast

Floats = NDArray[np.float32]

LANES = 32
LAGS = 6
# Pixels on either side of a lane's origin, at row MIDDLE of `values` and `variance` (ROWS, LANES).
HALF = 60
MIDDLE = HALF + 1 + LAGS
ROWS = MIDDLE + HALF + 1
# The slope's unit in px, for numbers of like size in single precision.
UNIT = 8.0
MASKED = 1e14
# Squares of less leave the range of single precision, where processors are slow.
FAINT = 1e-10
SINGULAR = 1e-11

LARGEST_STEP, LARGEST_WIDTH_STEP = 1.5, 0.3
# A step this short, in px or in standard deviations of the centre, leaves an error far below the noise.
CONVERGED, CONVERGED_SIGMAS, CONVERGED_WIDTH = 0.05, 0.2, 0.1

# Offsets in the flat array. Sums over the pixels of weight · g² z⁰…z⁴, g z⁰…z³, z⁰…z², then of weight · residual times
# the five derivatives, then of weight · residual².
_GG, _G, _ONE, _RIGHT, _CHI2 = 0, 5 * LANES, 9 * LANES, 12 * LANES, 17 * LANES
_SUMS = 18
# Parameters: centre from the lane's origin, amplitude, logarithm of the width, background at the origin, its slope.
CENTRE, AMPLITUDE, LOG_WIDTH, LEVEL, SLOPE = (k * LANES for k in range(18, 23))
# Expected logarithm of the width and its precision; 1 while a lane goes on; results.
EXPECTED, PRIOR, ACTIVE, GOOD, MISFIT, VARIANCE = (k * LANES for k in range(23, 29))
# The centre's row of the inverse normal matrix, its own variance first.
_ROW = FISHER = 30 * LANES
# At the origin: z, background and its rise per z; the Gaussian and its ratio to the next pixel, upwards and downwards.
_Z, _INVERSE, _BASE, _RISE = (k * LANES for k in range(35, 39))
_UP, _UP_RATIO, _DOWN, _DOWN_RATIO, _SHRINK = (k * LANES for k in range(39, 44))
# The first and last pixel that a lane may use, from its origin, and how many it uses.
LOW, HIGH, USED = (k * LANES for k in range(44, 47))
NUMBERS = 47 * LANES


@compiled_fast
def exponential(x: np.float32) -> np.float32:
    """The exponential to 2e-7, for the vector unit: the library's is called lane by lane."""
    whole: np.float32 = np.floor(x * np.float32(1.442695041) + np.float32(0.5))
    r = x - whole * np.float32(0.6931471806)
    value = r * np.float32(1 / 720) + np.float32(1 / 120)
    value = value * r + np.float32(1 / 24)
    value = value * r + np.float32(1 / 6)
    value = value * r + np.float32(0.5)
    value = (value * r + np.float32(1.0)) * r + np.float32(1.0)
    exponent = min(max(np.int32(whole) + np.int32(127), np.int32(0)), np.int32(254))
    return value * np.int32(exponent * np.int32(1 << 23)).view(np.float32)


@compiled_fast
def _begin(s: Floats) -> None:
    """Model and Gaussian at the origin; the Gaussian at x ± 1 is that at x times a ratio, which shrinks evenly."""
    half = np.float32(0.5)
    for j in range(LANES):
        inverse = exponential(-s[LOG_WIDTH + j])
        z = -s[CENTRE + j] * inverse
        rise = s[SLOPE + j] / (inverse * np.float32(UNIT))
        s[_Z + j] = z
        s[_INVERSE + j] = inverse
        s[_BASE + j] = s[LEVEL + j] - rise * z
        s[_RISE + j] = rise
        shrink = exponential(-half * inverse * inverse)
        up = exponential(-inverse * z)
        down = shrink / up
        peak = exponential(-half * z * z)
        s[_UP + j] = peak
        s[_UP_RATIO + j] = up * shrink
        s[_DOWN + j] = peak * down
        s[_DOWN_RATIO + j] = down * shrink * shrink
        s[_SHRINK + j] = shrink * shrink


@compiled_fast
def accumulate(
    s: Floats, values: Floats, variance: Floats, half: int, noise2: np.float32, gain: np.float32, contrast2: np.float32
) -> None:
    """The sums of all lanes over the pixels −half − 1 … half around their origins, in DN² as in `fit_lines`."""
    zero, one, faint = np.float32(0.0), np.float32(1.0), np.float32(FAINT)
    _begin(s)
    for k in range(_SUMS * LANES):
        s[k] = zero
    for step in range(half + 1):
        for j in range(LANES):
            z0, inverse, shrink = s[_Z + j], s[_INVERSE + j], s[_SHRINK + j]
            base, rise, amplitude = s[_BASE + j], s[_RISE + j], s[AMPLITUDE + j]
            up, up_ratio, down, down_ratio = s[_UP + j], s[_UP_RATIO + j], s[_DOWN + j], s[_DOWN_RATIO + j]
            gg0, gg1, gg2 = s[_GG + j], s[_GG + 1 * LANES + j], s[_GG + 2 * LANES + j]
            gg3, gg4 = s[_GG + 3 * LANES + j], s[_GG + 4 * LANES + j]
            g0, g1, g2, g3 = s[_G + j], s[_G + 1 * LANES + j], s[_G + 2 * LANES + j], s[_G + 3 * LANES + j]
            one0, one1, one2 = s[_ONE + j], s[_ONE + 1 * LANES + j], s[_ONE + 2 * LANES + j]
            right0, right1, right2 = s[_RIGHT + j], s[_RIGHT + 1 * LANES + j], s[_RIGHT + 2 * LANES + j]
            right3, right4, chi2 = s[_RIGHT + 3 * LANES + j], s[_RIGHT + 4 * LANES + j], s[_CHI2 + j]
            # One pixel upwards and one downwards.
            for side in range(2):
                x, g = (step, up) if side == 0 else (-1 - step, down)
                z = z0 + np.float32(x) * inverse
                stripe = amplitude * g
                mean = base + rise * z + stripe
                speckle = contrast2 * stripe * stripe
                weight = one / (noise2 + gain * max(mean, zero) + speckle + variance[MIDDLE + x, j])
                residual = values[MIDDLE + x, j] - mean
                error = weight * residual
                z_weight, g_weight = weight * z, weight * g
                zg_weight = g_weight * z
                zzg_weight = zg_weight * z
                gg = g_weight * g
                ggz = gg * z
                ggzz = ggz * z
                ggzzz = ggzz * z
                gg0, gg1, gg2, gg3, gg4 = gg0 + gg, gg1 + ggz, gg2 + ggzz, gg3 + ggzzz, gg4 + ggzzz * z
                g0, g1, g2, g3 = g0 + g_weight, g1 + zg_weight, g2 + zzg_weight, g3 + zzg_weight * z
                one0, one1, one2 = one0 + weight, one1 + z_weight, one2 + z_weight * z
                right0, right1, right2 = (
                    right0 + zg_weight * residual,
                    right1 + g_weight * residual,
                    right2 + zzg_weight * residual,
                )
                right3, right4, chi2 = right3 + error, right4 + error * z, chi2 + error * residual
            s[_UP + j], s[_UP_RATIO + j] = max(up * up_ratio, faint), up_ratio * shrink
            s[_DOWN + j], s[_DOWN_RATIO + j] = max(down * down_ratio, faint), down_ratio * shrink
            s[_GG + j], s[_GG + 1 * LANES + j], s[_GG + 2 * LANES + j] = gg0, gg1, gg2
            s[_GG + 3 * LANES + j], s[_GG + 4 * LANES + j] = gg3, gg4
            s[_G + j], s[_G + 1 * LANES + j], s[_G + 2 * LANES + j], s[_G + 3 * LANES + j] = g0, g1, g2, g3
            s[_ONE + j], s[_ONE + 1 * LANES + j], s[_ONE + 2 * LANES + j] = one0, one1, one2
            s[_RIGHT + j], s[_RIGHT + 1 * LANES + j], s[_RIGHT + 2 * LANES + j] = right0, right1, right2
            s[_RIGHT + 3 * LANES + j], s[_RIGHT + 4 * LANES + j], s[_CHI2 + j] = right3, right4, chi2


@compiled_fast
def step_on(s: Floats) -> float:
    """Solve by Cholesky factors, take the step in the lanes that go on; how many of them are not done yet."""
    tiny, one = np.float32(1e-12), np.float32(1.0)
    third, three = np.float32(0.3), np.float32(3.0)
    largest, widest = np.float32(LARGEST_STEP), np.float32(LARGEST_WIDTH_STEP)
    left = np.float32(0.0)
    for j in range(LANES):
        amplitude = s[AMPLITUDE + j]
        share = one / amplitude
        prior = s[PRIOR + j] * share
        right2 = s[_RIGHT + 2 * LANES + j] + prior * (s[EXPECTED + j] - s[LOG_WIDTH + j])
        p0 = max(s[_GG + 2 * LANES + j], tiny)
        i0 = one / np.sqrt(p0)
        a10, a20 = s[_GG + 1 * LANES + j] * i0, s[_GG + 3 * LANES + j] * i0
        a30, a40 = s[_G + 1 * LANES + j] * i0, s[_G + 2 * LANES + j] * i0
        p1 = max(s[_GG + j] - a10 * a10, tiny)
        i1 = one / np.sqrt(p1)
        a21 = (s[_GG + 2 * LANES + j] - a20 * a10) * i1
        a31 = (s[_G + j] - a30 * a10) * i1
        a41 = (s[_G + 1 * LANES + j] - a40 * a10) * i1
        p2 = max(s[_GG + 4 * LANES + j] + prior * share - a20 * a20 - a21 * a21, tiny)
        i2 = one / np.sqrt(p2)
        a32 = (s[_G + 2 * LANES + j] - a30 * a20 - a31 * a21) * i2
        a42 = (s[_G + 3 * LANES + j] - a40 * a20 - a41 * a21) * i2
        p3 = max(s[_ONE + j] - a30 * a30 - a31 * a31 - a32 * a32, tiny)
        i3 = one / np.sqrt(p3)
        a43 = (s[_ONE + 1 * LANES + j] - a40 * a30 - a41 * a31 - a42 * a32) * i3
        p4 = max(s[_ONE + 2 * LANES + j] - a40 * a40 - a41 * a41 - a42 * a42 - a43 * a43, tiny)
        i4 = one / np.sqrt(p4)
        y0 = s[_RIGHT + j] * i0
        y1 = (s[_RIGHT + 1 * LANES + j] - a10 * y0) * i1
        y2 = (right2 - a20 * y0 - a21 * y1) * i2
        y3 = (s[_RIGHT + 3 * LANES + j] - a30 * y0 - a31 * y1 - a32 * y2) * i3
        y4 = (s[_RIGHT + 4 * LANES + j] - a40 * y0 - a41 * y1 - a42 * y2 - a43 * y3) * i4
        # The misfit that this step leaves, to second order.
        misfit = s[_CHI2 + j] - (y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3 + y4 * y4)
        x4 = y4 * i4
        x3 = (y3 - a43 * x4) * i3
        x2 = (y2 - a42 * x4 - a32 * x3) * i2
        x1 = (y1 - a41 * x4 - a31 * x3 - a21 * x2) * i1
        x0 = (y0 - a40 * x4 - a30 * x3 - a20 * x2 - a10 * x1) * i0
        v1 = -a10 * i0 * i1
        v2 = -(a20 * i0 + a21 * v1) * i2
        v3 = -(a30 * i0 + a31 * v1 + a32 * v2) * i3
        v4 = -(a40 * i0 + a41 * v1 + a42 * v2 + a43 * v3) * i4
        u4 = v4 * i4
        u3 = (v3 - a43 * u4) * i3
        u2 = (v2 - a42 * u4 - a32 * u3) * i2
        u1 = (v1 - a41 * u4 - a31 * u3 - a21 * u2) * i1
        u0 = (i0 - a40 * u4 - a30 * u3 - a20 * u2 - a10 * u1) * i0
        # From the directions' coefficients to the parameters: d centre = scale · x0.
        inverse = s[_INVERSE + j]
        scale = share / inverse
        centre, width = scale * x0, share * x2
        fisher = scale * scale * u0
        active = s[ACTIVE + j]
        changed = min(max(amplitude + x1, third * amplitude), three * amplitude)
        s[AMPLITUDE + j] = amplitude + active * (changed - amplitude)
        s[CENTRE + j] += active * min(max(centre, -largest), largest)
        s[LOG_WIDTH + j] += active * min(max(width, -widest), widest)
        s[LEVEL + j] += active * (x3 + x4 * s[_Z + j])
        s[SLOPE + j] += active * (x4 * inverse * np.float32(UNIT))
        row2, row3, row4 = scale * share * u2, scale * (u3 + u4 * s[_Z + j]), scale * u4 * inverse * np.float32(UNIT)
        s[_ROW + j] += active * (fisher - s[_ROW + j])
        s[_ROW + 1 * LANES + j] += active * (scale * u1 - s[_ROW + 1 * LANES + j])
        s[_ROW + 2 * LANES + j] += active * (row2 - s[_ROW + 2 * LANES + j])
        s[_ROW + 3 * LANES + j] += active * (row3 - s[_ROW + 3 * LANES + j])
        s[_ROW + 4 * LANES + j] += active * (row4 - s[_ROW + 4 * LANES + j])
        s[MISFIT + j] += active * (misfit - s[MISFIT + j])
        s[GOOD + j] = min(p0, p1, p2, p3, p4)
        short = max(np.float32(CONVERGED**2), np.float32(CONVERGED_SIGMAS**2) * fisher)
        done = (centre * centre < short) and (abs(width) < np.float32(CONVERGED_WIDTH))
        s[ACTIVE + j] = np.float32(0.0) if done else active
        left += s[ACTIVE + j]
    return float(left)


@compiled_fast
def influence(
    s: Floats, variance: Floats, half: int, noise2: np.float32, gain: np.float32, contrast2: np.float32, rho: Floats,
    moved: Floats,
) -> None:  # fmt: skip
    """Variance of the centre in `VARIANCE` for noise whose speckle part is correlated by `rho` at lags 1 … `LAGS`.

    The influence of a pixel on the centre is its weight times its derivatives times the centre's row of the inverse.
    `moved` (ROWS, LANES) and the row are overwritten.
    """
    zero, one, faint = np.float32(0.0), np.float32(1.0), np.float32(FAINT)
    _begin(s)
    for j in range(LANES):
        amplitude, inverse = s[AMPLITUDE + j], s[_INVERSE + j]
        # The width's prior is one more datum.
        s[VARIANCE + j] = s[_ROW + 2 * LANES + j] * s[_ROW + 2 * LANES + j] * s[PRIOR + j]
        # From the parameters' derivatives to z g, g, z² g, 1 and z.
        slope = s[_ROW + 4 * LANES + j] / (inverse * np.float32(UNIT))
        s[_ROW + j] *= amplitude * inverse
        s[_ROW + 2 * LANES + j] *= amplitude
        s[_ROW + 3 * LANES + j] -= slope * s[_Z + j]
        s[_ROW + 4 * LANES + j] = slope
    for step in range(half + 1):
        for j in range(LANES):
            z0, inverse, shrink = s[_Z + j], s[_INVERSE + j], s[_SHRINK + j]
            base, rise, amplitude = s[_BASE + j], s[_RISE + j], s[AMPLITUDE + j]
            row0, row1, row2 = s[_ROW + j], s[_ROW + 1 * LANES + j], s[_ROW + 2 * LANES + j]
            row3, row4, total = s[_ROW + 3 * LANES + j], s[_ROW + 4 * LANES + j], s[VARIANCE + j]
            up, up_ratio, down, down_ratio = s[_UP + j], s[_UP_RATIO + j], s[_DOWN + j], s[_DOWN_RATIO + j]
            for side in range(2):
                x, g = (step, up) if side == 0 else (-1 - step, down)
                z = z0 + np.float32(x) * inverse
                stripe = amplitude * g
                mean = base + rise * z + stripe
                speckle = contrast2 * stripe * stripe
                weight = one / (noise2 + gain * max(mean, zero) + speckle + variance[MIDDLE + x, j])
                share = row3 + row4 * z + g * (row1 + z * (row0 + row2 * z))
                pull = weight * share
                moved[MIDDLE + x, j] = pull * stripe
                total += pull * share
            s[VARIANCE + j] = total
            s[_UP + j], s[_UP_RATIO + j] = max(up * up_ratio, faint), up_ratio * shrink
            s[_DOWN + j], s[_DOWN_RATIO + j] = max(down * down_ratio, faint), down_ratio * shrink
    first = MIDDLE - half - 1
    for k in range(first - LAGS, first):
        for j in range(LANES):
            moved[k, j] = zero
    for k in range(first, MIDDLE + half + 1):
        for j in range(LANES):
            others = zero
            for lag in range(LAGS):
                others += rho[lag] * moved[k - 1 - lag, j]
            s[VARIANCE + j] += np.float32(2.0) * contrast2 * moved[k, j] * others
