"""The likeliest centre of the stripe in each line: the compiled maximum likelihood fit of a Gaussian.

Fisher scoring on centre, amplitude, width and linear background (docs/explanation/theory.md, section 5), `LANES` lines
side by side: the processor's vector unit does one pixel of all lanes at once. The numbers of a batch lie in one flat
array, quantity by quantity, and loops over lanes hold nothing but arithmetic. With z = (x − centre) / width and g the
Gaussian, the model's derivatives are z g, g, z² g, 1 and z but for factors: so sums of five powers of z under g², four
under g and three under 1 are the whole normal matrix.
"""

import numpy as np

from cell.base.compiled import compiled, compiled_fast
from cell.measure.vision.stripe.ordinary.find import (
    BACKGROUND,
    CENTRE,
    CORE,
    CUT,
    HEIGHT,
    LANES,
    Array,
    Floats,
    Image,
    Shade,
    Whole,
)

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
_CENTRE, _AMPLITUDE, _LOG_WIDTH, _LEVEL, _SLOPE = (k * LANES for k in range(18, 23))
# Expected logarithm of the width and its precision; 1 while a lane goes on; results.
_EXPECTED, _PRIOR, _ACTIVE, _GOOD, _MISFIT, _VARIANCE = (k * LANES for k in range(23, 29))
# The centre's row of the inverse normal matrix, its own variance first.
_ROW = 30 * LANES
# At the origin: z, background and its rise per z; the Gaussian and its ratio to the next pixel, upwards and downwards.
_Z, _INVERSE, _BASE, _RISE = (k * LANES for k in range(35, 39))
_UP, _UP_RATIO, _DOWN, _DOWN_RATIO, _SHRINK = (k * LANES for k in range(39, 44))
# The first and last pixel that a lane may use, from its origin, and how many it uses.
_LOW, _HIGH, _USED = (k * LANES for k in range(44, 47))
_NUMBERS = 47 * LANES

# Rows of the result. SIGMA is the centre's standard deviation with the noise as it is correlated, FISHER without.
FIT_CENTRE, SIGMA, AMPLITUDE, WIDTH, LEVEL, SLOPE, CHI2, FISHER = range(8)
FITTED = 8
PARAMETERS = 5
# Standard deviation of the prior on the logarithm of the width: from the count of pixels, and that of a clipped peak.
WIDTH_PRIOR, CLIPPED_PRIOR = 0.25, 0.7
# Centres half way between two pixels are common in whole numbers: rounding is not to decide on the side.
NEAREST = 0.499


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
def _at_origin(s: Floats) -> None:
    """Model and Gaussian at the origin; the Gaussian at x ± 1 is that at x times a ratio, which shrinks evenly."""
    half = np.float32(0.5)
    for j in range(LANES):
        inverse = exponential(-s[_LOG_WIDTH + j])
        z = -s[_CENTRE + j] * inverse
        rise = s[_SLOPE + j] / (inverse * np.float32(UNIT))
        s[_Z + j] = z
        s[_INVERSE + j] = inverse
        s[_BASE + j] = s[_LEVEL + j] - rise * z
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
    _at_origin(s)
    for k in range(_SUMS * LANES):
        s[k] = zero
    for step in range(half + 1):
        for j in range(LANES):
            z0, inverse, shrink = s[_Z + j], s[_INVERSE + j], s[_SHRINK + j]
            base, rise, amplitude = s[_BASE + j], s[_RISE + j], s[_AMPLITUDE + j]
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
        amplitude = s[_AMPLITUDE + j]
        share = one / amplitude
        prior = s[_PRIOR + j] * share
        right2 = s[_RIGHT + 2 * LANES + j] + prior * (s[_EXPECTED + j] - s[_LOG_WIDTH + j])
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
        active = s[_ACTIVE + j]
        changed = min(max(amplitude + x1, third * amplitude), three * amplitude)
        s[_AMPLITUDE + j] = amplitude + active * (changed - amplitude)
        s[_CENTRE + j] += active * min(max(centre, -largest), largest)
        s[_LOG_WIDTH + j] += active * min(max(width, -widest), widest)
        s[_LEVEL + j] += active * (x3 + x4 * s[_Z + j])
        s[_SLOPE + j] += active * (x4 * inverse * np.float32(UNIT))
        row2, row3, row4 = scale * share * u2, scale * (u3 + u4 * s[_Z + j]), scale * u4 * inverse * np.float32(UNIT)
        s[_ROW + j] += active * (fisher - s[_ROW + j])
        s[_ROW + 1 * LANES + j] += active * (scale * u1 - s[_ROW + 1 * LANES + j])
        s[_ROW + 2 * LANES + j] += active * (row2 - s[_ROW + 2 * LANES + j])
        s[_ROW + 3 * LANES + j] += active * (row3 - s[_ROW + 3 * LANES + j])
        s[_ROW + 4 * LANES + j] += active * (row4 - s[_ROW + 4 * LANES + j])
        s[_MISFIT + j] += active * (misfit - s[_MISFIT + j])
        s[_GOOD + j] = min(p0, p1, p2, p3, p4)
        short = max(np.float32(CONVERGED**2), np.float32(CONVERGED_SIGMAS**2) * fisher)
        done = (centre * centre < short) and (abs(width) < np.float32(CONVERGED_WIDTH))
        s[_ACTIVE + j] = np.float32(0.0) if done else active
        left += s[_ACTIVE + j]
    return float(left)


@compiled_fast
def influence(
    s: Floats, variance: Floats, half: int, noise2: np.float32, gain: np.float32, contrast2: np.float32, rho: Floats,
    moved: Floats,
) -> None:  # fmt: skip
    """Variance of the centre in `_VARIANCE` for noise whose speckle part is correlated by `rho` at lags 1 … `LAGS`.

    The influence of a pixel on the centre is its weight times its derivatives times the centre's row of the inverse.
    `moved` (ROWS, LANES) and the row are overwritten.
    """
    zero, one, faint = np.float32(0.0), np.float32(1.0), np.float32(FAINT)
    _at_origin(s)
    for j in range(LANES):
        amplitude, inverse = s[_AMPLITUDE + j], s[_INVERSE + j]
        # The width's prior is one more datum.
        s[_VARIANCE + j] = s[_ROW + 2 * LANES + j] * s[_ROW + 2 * LANES + j] * s[_PRIOR + j]
        # From the parameters' derivatives to z g, g, z² g, 1 and z.
        slope = s[_ROW + 4 * LANES + j] / (inverse * np.float32(UNIT))
        s[_ROW + j] *= amplitude * inverse
        s[_ROW + 2 * LANES + j] *= amplitude
        s[_ROW + 3 * LANES + j] -= slope * s[_Z + j]
        s[_ROW + 4 * LANES + j] = slope
    for step in range(half + 1):
        for j in range(LANES):
            z0, inverse, shrink = s[_Z + j], s[_INVERSE + j], s[_SHRINK + j]
            base, rise, amplitude = s[_BASE + j], s[_RISE + j], s[_AMPLITUDE + j]
            row0, row1, row2 = s[_ROW + j], s[_ROW + 1 * LANES + j], s[_ROW + 2 * LANES + j]
            row3, row4, total = s[_ROW + 3 * LANES + j], s[_ROW + 4 * LANES + j], s[_VARIANCE + j]
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
            s[_VARIANCE + j] = total
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
            s[_VARIANCE + j] += np.float32(2.0) * contrast2 * moved[k, j] * others


@compiled
def _begin(s: Floats, start: Array, widths: Array, log_widths: Array, lines: Whole, n: int, origins: Whole) -> int:
    """Starts of the lanes from their `lines`' peaks in `find_lines`, and their origins (LANES,). Returns how far from
    its origin, in px, the lane looks that looks farthest."""
    farthest = 0
    for j in range(LANES):
        r = lines[j]
        width, core, centre = widths[r], start[r, 0, CORE], start[r, 0, CENTRE]
        clipped = core > 1
        origin = origins[j] = int(np.floor(centre + NEAREST))
        prior = CLIPPED_PRIOR if clipped else WIDTH_PRIOR
        rise = np.exp(min(4.0, 0.5 * (0.5 * core / width) ** 2)) if clipped else 1.0
        s[_CENTRE + j] = centre - origin
        s[_AMPLITUDE + j] = start[r, 0, HEIGHT] * rise
        s[_LOG_WIDTH + j] = s[_EXPECTED + j] = log_widths[r]
        s[_LEVEL + j] = start[r, 0, BACKGROUND]
        s[_SLOPE + j] = 0.0
        s[_PRIOR + j] = 1.0 / (prior * prior)
        s[_ACTIVE + j] = 1.0
        s[_USED + j] = 0.0
        reach = int(min(float(HALF), 0.5 * core + 4.0 * width + 3.0))
        s[_LOW + j], s[_HIGH + j] = max(-reach, -origin), min(reach, n - 1 - origin)
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
    masked, zero, one, limit = np.float32(MASKED), np.float32(0.0), np.float32(1.0), np.float32(saturation)
    for x in range(-half - 1, half + 1):
        k = MIDDLE + x
        place = np.float32(x)
        for j in range(LANES):
            usable = (values[k, j] < limit) & (place >= s[_LOW + j]) & (place <= s[_HIGH + j])
            variance[k, j] = zero if usable else masked
            s[_USED + j] += one if usable else zero


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
    s = np.zeros(_NUMBERS, np.float32)
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
            accumulate(s, values, variance, half=half, noise2=noise2, gain=gain, contrast2=contrast2)
            if step_on(s) == 0.0:
                break
        for j in range(LANES):
            fisher[j] = s[_ROW + j]
            fitted_width[j] = exponential(s[_LOG_WIDTH + j])
        correlated = bool(len(rho) > 0 and contrast2 > 0.0)
        if correlated:
            influence(s, variance, half, noise2=noise2, gain=gain, contrast2=contrast2, rho=rho, moved=moved)
        _note(s, lines[:size], origins, fisher=fisher, widths=fitted_width, correlated=correlated, out=out)


@compiled
def _note(
    s: Floats, lines: Whole, origins: Whole, fisher: Floats, widths: Floats, correlated: bool, out: Array
) -> None:
    """The lanes' results into `out` (FITTED, lines); those with too few pixels or a singular matrix are left alone."""
    for j in range(len(lines)):
        used = s[_USED + j]
        if used <= PARAMETERS or not s[_GOOD + j] > SINGULAR:
            continue
        r = lines[j]
        out[FIT_CENTRE, r] = origins[j] + s[_CENTRE + j]
        out[SIGMA, r] = np.sqrt(s[_VARIANCE + j] if correlated else fisher[j])
        out[AMPLITUDE, r] = s[_AMPLITUDE + j]
        out[WIDTH, r] = widths[j]
        out[LEVEL, r] = s[_LEVEL + j]
        out[SLOPE, r] = s[_SLOPE + j] / UNIT
        out[CHI2, r] = s[_MISFIT + j] / (used - PARAMETERS)
        out[FISHER, r] = np.sqrt(fisher[j])
