"""From lines that are found to the profile they share: fit, register, learn, fit again, and judge on held-out lines."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.careful.shaped_fit import Fitted, Noise, Plane, Shape, fit_shape, gaussian, learn
from cell.measure.vision.stripe.ordinary.speckle import ASSUMED_GRAIN

Array = NDArray[np.float64]

ROUNDS = 5
LEAST_LINES = 40
MOST_LINES, MOST_SAMPLES, RUN = 512, 9000, 32
NEAR = 9
"""Lines on either side that say where a line's centre should be."""
REACH, FARTHEST = 4.0, 10.0
"""How far from the centre a profile is looked at, in widths: at least, and where a halo shows, at most."""
FAINT = 0.012
"""Of the peak: below this share a halo has ended."""
BETTER, SURE = 0.01, 4.0
"""Held-out lines have to fit better by this share, and by so many standard deviations, for a profile to be believed."""
FAINT_SPECKLE = 0.03
FREE_SCALE, SHARED_SCALE, LEAST_SCALE = 0.25, 0.15, 0.001
"""Standard deviations of the logarithm of a line's scale: before it is known, once it is, and the least assumed."""
ALIKE, LEAST_ALIKE, KEPT = 0.35, 12, 0.95
"""Lines whose amplitude differs from the typical one by no more than this share tell the speckle; how many of them."""
SPECKLE_SIGMAS = 3.0
PHASES = (-0.375, -0.125, 0.125, 0.375)


def learn_profile(
    plane: Plane, lines: NDArray[np.intp], starts: Array, width: float, noise: Noise
) -> tuple[Shape, float, Noise]:
    """The profile of `lines` (m,) about `starts` (m,) px, how much its scale differs from line to line, and the noise.
    `width` is the σ in px to begin with. A Gaussian comes back where the lines show nothing else, or are too few."""
    if len(lines) > MOST_LINES:
        some = _runs(len(lines), MOST_LINES)
        lines, starts = lines[some], starts[some]
    plain = gaussian(width, REACH * width + 2)
    for _ in range(3):
        fitted = fit_shape(plane, lines, starts, shape=plain, noise=noise, scale_prior=FREE_SCALE)
        clear = _clear(fitted, plane)
        if clear.sum() < min(LEAST_LINES, 8):
            return plain, FREE_SCALE, noise
        width = plain.width * float(np.exp(np.clip(np.median(fitted.log_scale[clear]), -0.7, 0.7)))
        plain = gaussian(width, REACH * width + 2)
    noise = speckled(fitted, clear, noise, plain)
    spread = _spread(fitted, clear)
    if clear.sum() < LEAST_LINES:
        return plain, spread, noise
    starts = np.where(fitted.good, fitted.centre, starts)
    reach = _extent(plane, fitted, clear, width)
    if len(lines) * reach > MOST_SAMPLES:
        some = _runs(len(lines), int(MOST_SAMPLES / reach))
        lines, starts = lines[some], starts[some]
    # Runs of neighbours, which share the texture of the surface, are taught or held out together.
    taught_by = np.arange(len(lines)) // RUN % 2 == 0
    if taught_by.all():
        taught_by[len(lines) // 2 :] = False
    taught, _, _ = _rounds(plane, lines[taught_by], starts[taught_by], width=width, reach=reach, noise=noise)
    of_taught, of_plain = (
        fit_shape(plane, lines[~taught_by], starts[~taught_by], shape=shape, noise=noise, scale_prior=SHARED_SCALE)
        for shape in (taught, gaussian(width, reach))
    )
    if not _better(of_taught, of_plain):
        return plain, spread, noise
    # What a Gaussian misfits by looked like speckle: with the profile's own residuals once more, from none on.
    noise = Noise(noise.floor, noise.gain)
    for _ in range(2):
        shape, fitted, clear = _rounds(plane, lines, starts, width=width, reach=reach, noise=noise)
        noise = speckled(fitted, clear, noise, shape)
        if noise.contrast < FAINT_SPECKLE:
            break
    freely = fit_shape(plane, lines, starts, shape=shape, noise=noise, scale_prior=FREE_SCALE)
    return shape, _spread(freely, clear & _clear(freely, plane)), noise


def _rounds(
    plane: Plane, lines: NDArray[np.intp], starts: Array, width: float, reach: float, noise: Noise
) -> tuple[Shape, Fitted, NDArray[np.bool_]]:
    shape, prior = gaussian(width, reach), FREE_SCALE
    for _ in range(ROUNDS):
        fitted = fit_shape(plane, lines, starts, shape=shape, noise=noise, scale_prior=prior)
        clear = _clear(fitted, plane)
        if clear.sum() < LEAST_LINES // 4:
            break
        amplitude = fitted.amplitude[clear, None]
        # The typical line has the profile's own scale.
        typical = float(np.exp(np.median(fitted.log_scale[clear])))
        x, seen = typical * _registered(fitted)[clear], (fitted.residual + fitted.stripe)[clear] / amplitude
        weight = amplitude**2 / fitted.variance[clear]
        # No line counts for more than its share, and no pixel far more than another.
        weight = np.minimum(weight, 4 * np.median(weight[weight > 0]))
        shape = learn(x.ravel(), seen.ravel(), weight.ravel(), width, reach)
        width = shape.width
        starts = np.where(fitted.good, fitted.centre, starts)
        prior = SHARED_SCALE
    fitted = fit_shape(plane, lines, starts, shape=shape, noise=noise, scale_prior=prior)
    return shape, fitted, _clear(fitted, plane)


def _runs(count: int, wanted: int) -> NDArray[np.intp]:
    """Indices of about `wanted` of `count` lines, in runs of RUN neighbours all over the picture."""
    begins = np.linspace(0, max(0, count - RUN), max(4, wanted // RUN)).astype(np.intp)
    return np.unique(np.minimum((begins[:, None] + np.arange(RUN)).ravel(), count - 1))


def _registered(fitted: Fitted) -> Array:
    """Where pixels are from the centre (m, k), in px over the scale, without what centres err by the place in a pixel.

    A profile narrower than two pixels explains a picture just as well with centres that err wherever a stripe falls on
    a pixel alike: only the line, which runs on across the pixels' places, tells.
    """
    centre, lines, span = fitted.centre, fitted.lines, 2 * NEAR + 1
    if len(lines) < 4 * span:
        return fitted.x
    away = np.arange(-NEAR, NEAR + 1.0)
    parabola = np.linalg.pinv(np.stack([np.ones(span), away, away**2], axis=1))[0]
    rows, near = (np.lib.stride_tricks.sliding_window_view(values, span) for values in (lines, centre))
    middle = slice(NEAR, -NEAR)
    error = centre[middle] - near @ parabola
    calm = (rows[:, -1] - rows[:, 0] == span - 1) & (np.abs(error) < 3 * np.median(np.abs(error)) + 1e-6)
    turn = 2 * np.pi * np.outer(centre, (1, 2))
    waves = np.hstack([np.sin(turn), np.cos(turn)])
    if calm.sum() < 4 * span:
        return fitted.x
    size = np.linalg.lstsq(waves[middle][calm], error[calm], rcond=None)[0]
    by_chance = 2 * waves.shape[1] * float(np.var(error[calm])) / int(calm.sum())
    by_place = waves @ size * max(0.0, 1 - 2 * by_chance / max(float(size @ size), 1e-12))
    return np.asarray(fitted.x + (by_place * np.exp(-fitted.log_scale))[:, None])


def _clear(fitted: Fitted, plane: Plane) -> NDArray[np.bool_]:
    """True (m,) of the lines that show one stripe, fitted as well as most are."""
    good = fitted.good & (fitted.amplitude > 4 * fitted.amplitude_sigma)
    good &= np.abs(fitted.log_scale) < 1.2
    if not good.any():
        return good
    worst = 3 * float(np.median(fitted.chi2[good]))
    return np.asarray(good & (fitted.chi2 < worst))


def _spread(fitted: Fitted, clear: NDArray[np.bool_]) -> float:
    """By how much the scale's logarithm differs from line to line, beyond what noise makes of it."""
    off = fitted.log_scale[clear] - np.median(fitted.log_scale[clear])
    seen = (1.4826 * float(np.median(np.abs(off)))) ** 2
    noise = float(np.median(fitted.scale_sigma[clear] ** 2))
    return float(np.sqrt(np.clip(seen - noise, LEAST_SCALE**2, FREE_SCALE**2)))


def _extent(plane: Plane, fitted: Fitted, clear: NDArray[np.bool_], width: float) -> float:
    """How far from the centre in px the lines' mean profile stands out from what is around it."""
    n = plane.value.shape[1]
    farthest = int(min(FARTHEST * width + 4, n / 2 - 2))
    column = np.rint(fitted.centre[clear]).astype(np.intp)[:, None] + np.arange(-farthest, farthest + 1)
    inside = (column >= 0) & (column < n)
    at = fitted.lines[clear][:, None], np.clip(column, 0, n - 1)
    usable = inside & plane.usable[at]
    value = (plane.value[at] - fitted.level[clear, None]) / fitted.amplitude[clear, None]
    value = np.where(usable, value, np.nan)
    many = usable.mean(axis=0) > 0.5
    mean = np.full(value.shape[1], np.nan)
    mean[many] = np.nanmedian(value[:, many], axis=0)
    x = np.arange(-farthest, farthest + 1)
    ends = many & (np.abs(x) > 0.85 * farthest)
    if ends.sum() < 4:
        return REACH * width + 2
    mean = mean - np.polyval(np.polyfit(x[ends], mean[ends], 1), x)
    scatter = 4 * float(np.nanstd(mean[ends])) + FAINT
    bright = many & (np.abs(mean) > scatter)
    # From the centre outwards, to the first gap of a width.
    reach = REACH * width
    for side in (-1, 1):
        away = np.sort(np.abs(x[bright & (x * side > 0)]))
        gaps = np.flatnonzero(np.diff(away, prepend=0) > max(2.0, width))
        if len(gaps):
            away = away[: gaps[0]]
        if len(away):
            reach = max(reach, float(away[-1]) + 1.5 * width)
    return min(reach + 2, float(farthest))


def _better(one: Fitted, other: Fitted) -> bool:
    """True when lines are fitted clearly better by the first of two profiles."""
    good = one.good & other.good
    if good.sum() < LEAST_LINES // 4:
        return False
    gain = other.chi2[good] - one.chi2[good]
    gain = gain[np.abs(gain - np.median(gain)) <= np.quantile(np.abs(gain - np.median(gain)), 0.95)]
    chance = float(gain.std()) / np.sqrt(len(gain))
    return bool(gain.mean() > SURE * chance and gain.mean() > BETTER * np.median(one.chi2[good]))


def speckled(fitted: Fitted, clear: NDArray[np.bool_], noise: Noise, shape: Shape) -> Noise:
    """The noise with the contrast that the residuals of the `clear` lines (m,) show under the stripe, at most 1."""
    if not clear.any():
        return noise
    typical = float(np.median(fitted.amplitude[clear]))
    whole = np.isfinite(fitted.variance).mean(axis=1) > 0.9
    alike = clear & whole & (np.abs(fitted.amplitude - typical) < ALIKE * typical)
    if alike.sum() < LEAST_ALIKE:
        return replace(noise, contrast=0.0)
    usable = np.isfinite(fitted.variance[alike])
    height = fitted.amplitude[alike, None]
    profile = np.where(usable, fitted.stripe[alike] / height, 0.0)
    power = np.sum(profile**2 * (np.where(usable, fitted.residual[alike], 0.0) / height) ** 2, axis=1)
    power = power[power <= np.quantile(power, KEPT)]
    photons, speckle = _left(shape, typical, float(np.median(fitted.level[alike])), noise)
    excess = float(power.mean()) - photons * KEPT
    if excess < SPECKLE_SIGMAS * float(power.std()) / np.sqrt(len(power)):
        return replace(noise, contrast=0.0)
    return replace(noise, contrast=float(np.sqrt(min(excess / speckle, 1.0))))


def _left(shape: Shape, amplitude: float, level: float, noise: Noise) -> tuple[float, float]:
    """What the fit leaves of the noise without speckle and of speckle of contrast 1, as `speckled` sums it."""
    half = int(np.ceil(shape.reach)) + 1
    photons, speckle = 0.0, 0.0
    for phase in PHASES:
        x: Array = np.arange(-half, half + 1.0) - np.float64(phase)
        profile, slope = shape.at(x)
        variance = noise.floor + noise.gain * np.maximum(amplitude * profile + level, 0.0)
        weight = 1 / (variance + (noise.contrast * amplitude * profile) ** 2)
        jacobian = np.stack(
            [amplitude * slope, profile, amplitude * slope * x, np.ones_like(x), x / half], axis=1
        )  # fmt: skip
        normal = jacobian.T @ (weight[:, None] * jacobian)
        normal[2, 2] += SHARED_SCALE**-2
        kept = np.eye(len(x)) - jacobian @ np.linalg.solve(normal, (weight[:, None] * jacobian).T)
        rows = kept * profile[:, None] / amplitude
        photons += float(np.sum(rows**2 * variance)) / len(PHASES)
        pulled = rows * (amplitude * profile)
        grain = np.exp(-((x[:, None] - x) ** 2) / (4 * ASSUMED_GRAIN**2))
        speckle += float(np.sum((pulled @ grain) * pulled)) / len(PHASES)
    return photons, speckle
