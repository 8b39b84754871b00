"""The likeliest centre of lines that share a profile of any shape: Fisher scoring, all lines at once.

For what the compiled fit of a Gaussian does not take: learned profiles, colour and deep pictures, wide stripes, albedo
that a picture without the laser tells. Takes 5 to 20 ms a picture.

The stripe's own profile across the line: a Gaussian until the picture shows otherwise, then what the picture shows.

Registered lines give many samples of one profile at all sub-pixel places. What they differ from a Gaussian by is
fitted by a penalised cubic spline. It is kept where it foretells held-out lines better (docs/explanation/theory.md,
section 5)."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from cell.base.compiled import compiled

Array = NDArray[np.float64]

FINE = 16
"""Places of the table in one knot interval."""
KNOTS_PER_WIDTH = 8.0
# Precision of the differences of neighbouring spline coefficients, in samples: enough to bridge what no line shows.
SMOOTHING, RIDGE = 0.01, 1e-3


@dataclass(frozen=True)
class Shape:
    """A profile of height 1 as a table: `value` and `slope` (per px) at `first` + k · `step` px from the centre.

    `width` is the σ in px of the Gaussian that fits it best, and whose centre is the profile's. `learned` is False of a
    Gaussian.
    """

    first: float
    step: float
    value: Array
    slope: Array
    width: float
    learned: bool

    @property
    def reach(self) -> float:
        """How far from its centre, in px, the profile is known; it is 0 beyond."""
        return -self.first

    def at(self, x: Array) -> tuple[Array, Array]:
        """Value and slope of the profile at `x` px from its centre, any shape."""
        place = np.clip((x - self.first) / self.step, 0.0, len(self.value) - 1.000001)
        k = place.astype(np.intp)
        part = place - k
        value = self.value[k] + part * (self.value[k + 1] - self.value[k])
        slope = self.slope[k] + part * (self.slope[k + 1] - self.slope[k])
        return value, slope


def gaussian(width: float, reach: float | None = None) -> Shape:
    """The Gaussian of σ `width` px, as the mean over a pixel has it, to `reach` px, or 5 widths and a bit."""
    reach = reach or 5.0 * width + 2.0
    step = width / KNOTS_PER_WIDTH / FINE
    count = int(np.ceil(reach / step))
    z = np.arange(-count, count + 1) * (step / width)
    value = np.exp(-0.5 * z * z)
    return Shape(-count * step, step, value, slope=-value * z / width, width=width, learned=False)


def learn(x: Array, value: Array, weight: Array, width: float, reach: float) -> Shape:
    """The profile that samples `value` (m,) of height about 1 at `x` (m,) px from the centre show, with `weight` (m,).
    `width` is that of the Gaussian from which it is taken to differ, `reach` how far to look, both in px."""
    spacing = width / KNOTS_PER_WIDTH
    count = int(np.ceil(reach / spacing))
    knots = np.arange(-count - 3, count + 4) * spacing
    inside = np.abs(x) < count * spacing
    x, value, weight = x[inside], value[inside], weight[inside]
    base = np.exp(-0.5 * (x / width) ** 2)
    # Splines that lie farther than 3 apart do not overlap: the matrix is a band.
    size = 2 * count + 3
    band, right = np.zeros((4, size)), np.zeros(size)
    _gather(x / spacing + count, value - base, weight, band, right)
    # Of a stripe that is narrow in a wide reach most splines have no sample.
    typical = float(np.median(band[3][band[3] > 0])) if np.any(band[3] > 0) else 0.0
    if typical == 0:
        return gaussian(width, reach)
    band += typical * (SMOOTHING * _roughness(size))
    band[3] += typical * RIDGE
    spline = scipy.interpolate.BSpline(knots, scipy.linalg.solveh_banded(band, right), 3)
    step = spacing / FINE
    grid: Array = np.arange(-count * FINE, count * FINE + 1) * np.float64(step)
    table = spline(grid) + np.exp(-0.5 * (grid / width) ** 2)
    return _settled(grid, np.asarray(table, dtype=np.float64), step, width)


@lru_cache(maxsize=64)
def _roughness(size: int) -> Array:
    """The sum of the squared third differences of `size` coefficients as the upper band (4, size) of a matrix."""
    rough = np.diff(np.eye(size), 3, axis=0)
    whole, band = rough.T @ rough, np.zeros((4, size))
    for k in range(4):
        band[3 - k, k:] = np.diagonal(whole, k)
    return band


@compiled
def _gather(place: Array, value: Array, weight: Array, band: Array, right: Array) -> None:  # pragma: no cover
    """Adds the samples' normal equations for cubic splines on whole numbers: upper `band` (4, size), `right` (size,).
    `place` (m,) counts from the low end of what is looked at, where the last piece of the first spline begins."""
    basis = np.empty(4)
    for n in range(len(place)):
        first = min(max(int(place[n]), 0), len(right) - 4)
        t = place[n] - first
        basis[0] = (1 - t) ** 3 / 6
        basis[1] = (3 * t**3 - 6 * t**2 + 4) / 6
        basis[2] = (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6
        basis[3] = t**3 / 6
        for i in range(4):
            weighted = weight[n] * basis[i]
            right[first + i] += weighted * value[n]
            for j in range(i, 4):
                band[3 - (j - i), first + j] += weighted * basis[j]


def _settled(grid: Array, table: Array, step: float, width: float) -> Shape:
    """The table with its ends at 0, its height 1, and 0 where the best Gaussian has its centre."""
    end = max(1, len(grid) // 20)
    low, high = float(table[:end].mean()), float(table[-end:].mean())
    table = table - np.interp(grid, (grid[0], grid[-1]), (low, high))
    centre = 0.0
    for _ in range(12):
        z = (grid - centre) / width
        g = np.exp(-0.5 * z * z)
        basis = np.stack([g, g * z / width, g * z * z / width, np.ones_like(g)], axis=1)
        height, shift, wider, _ = np.linalg.lstsq(basis, table, rcond=None)[0]
        if height <= 0:
            break
        centre += float(np.clip(shift / height, -0.5 * width, 0.5 * width))
        width *= float(np.exp(np.clip(wider / height / width, -0.3, 0.3)))
    # The ends of what is looked at fade, so that lines that move against each other fit without a step.
    fade = np.clip((np.minimum(grid - grid[0], grid[-1] - grid) / (0.06 * (grid[-1] - grid[0]))), 0.0, 1.0)
    table = table * fade * fade * (3 - 2 * fade)
    table = np.interp(grid + centre, grid, table, left=0.0, right=0.0)
    table = table / max(float(table.max()), 1e-9)
    return Shape(float(grid[0]), step, table, slope=np.gradient(table, step), width=width, learned=True)


PARAMETERS = 5
STEPS = 10
LARGEST_STEP, LARGEST_SCALE_STEP = 0.7, 0.25
"""Of the centre in stripe widths, and of the logarithm of the scale."""
CONVERGED = 0.02
LEAST_PIXELS = 7
ALBEDO_DOUBT = 0.2
"""By which share of its deviation from the surroundings the albedo is off where its edges are blurred."""


@dataclass(frozen=True)
class Noise:
    """Variance of a pixel in DN²: `floor` + `gain` · value + (`contrast` · stripe)²."""

    floor: float
    gain: float
    contrast: float = 0.0


@dataclass(frozen=True)
class Plane:
    """What lines are read from, all (lines, n): `value` in DN, `usable` pixels, the `shade` that was taken off in DN,
    and the `albedo` relative to the surroundings, both None where nothing tells."""

    value: NDArray[np.float32]
    usable: NDArray[np.bool_]
    shade: NDArray[np.float32] | None = None
    albedo: NDArray[np.float32] | None = None


def binned(plane: Plane, k: int) -> Plane:
    """The plane of pixels that are `k` px wide, each the mean of what it holds; the last ones may fall away."""
    if k == 1:
        return plane
    n = plane.value.shape[1] // k

    def mean(part: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        if part is None:
            return None
        return np.asarray(part[:, : n * k].reshape(len(part), n, k).mean(axis=2), dtype=np.float32)

    value = mean(plane.value)
    assert value is not None
    usable = np.asarray(plane.usable[:, : n * k].reshape(len(value), n, k).all(axis=2))
    return Plane(value, usable, mean(plane.shade), mean(plane.albedo))


@dataclass(frozen=True)
class Fitted:
    """Fits of m lines in windows of k px: `centre` in px, `amplitude` and `level` in DN, `log_scale` of the profile,
    `chi2` per degree of freedom, `fisher` the centre's standard deviation if the noise is as declared and white;
    `good` lines have a solution. (m, k): `x` from the centre in px over the scale, `residual`, `stripe` in DN,
    `variance` in DN², infinite where not usable, and `influence` of each pixel on the centre in px/DN."""

    lines: NDArray[np.intp]
    centre: Array
    amplitude: Array
    amplitude_sigma: Array
    level: Array
    slope: Array
    log_scale: Array
    scale_sigma: Array
    chi2: Array
    fisher: Array
    good: NDArray[np.bool_]
    x: Array
    residual: Array
    stripe: Array
    variance: Array
    influence: Array


def fit_shape(
    plane: Plane, lines: NDArray[np.intp], starts: Array, shape: Shape, noise: Noise, scale_prior: float
) -> Fitted:
    """Fit `lines` (m,) of `plane` from `starts` (m,) px; the scale's logarithm is 0 ± `scale_prior`. Unknown are
    centre, amplitude, scale and a linear background."""
    n = plane.value.shape[1]
    half = int(np.ceil(shape.reach)) + 1
    offset = np.arange(-half, half + 1)
    origin = np.rint(starts).astype(np.intp)
    column = origin[:, None] + offset
    inside = (column >= 0) & (column < n)
    at = lines[:, None], np.clip(column, 0, n - 1)
    value = plane.value[at].astype(np.float64)
    usable = inside & plane.usable[at]
    shade, albedo = (
        np.full(value.shape, without) if known is None else known[at].astype(np.float64)
        for known, without in ((plane.shade, 0.0), (plane.albedo, 1.0))
    )
    # What is lighter or darker than its surroundings is not known exactly to be so.
    speckle = noise.contrast**2 + (ALBEDO_DOUBT * (1 - 1 / albedo)) ** 2
    ramp = np.broadcast_to(offset / half, value.shape)
    centre = starts - origin
    amplitude, level, slope = _linear_start(value, usable, offset, centre, shape=shape, ramp=ramp)
    found = np.stack([centre, amplitude, np.zeros(len(lines)), level, slope], axis=1)
    good = usable.sum(axis=1) > LEAST_PIXELS
    going = good.copy()
    inverses = np.zeros((len(lines), PARAMETERS, PARAMETERS))
    # Most lines settle in a few steps, a few take all of them: one that has settled is looked at once more and left.
    left = np.arange(len(lines))
    table = shape.first, shape.step, np.ascontiguousarray(shape.value), np.ascontiguousarray(shape.slope)
    pixels = value, usable, shade, albedo, speckle, offset / half
    limits = scale_prior**-2, LARGEST_STEP * shape.width, float(half)
    for _ in range(STEPS):
        began = going[left]
        _improve(
            left, table, pixels, noise=(noise.floor, noise.gain), limits=limits, found=found, good=good, going=going,
            inverses=inverses,
        )  # fmt: skip
        left = left[began]
        if not going.any():
            break
    centre, amplitude, log_scale, level, slope = found.T
    stripe, jacobian, mean = _model(offset, found, shape, ramp, albedo)
    variance = noise.floor + noise.gain * np.maximum(mean + shade, 0.0) + speckle * stripe**2
    weight = usable / variance
    residual = np.where(usable, value - mean, 0.0)
    influence = np.einsum("mp,mpk->mk", inverses[:, 0], jacobian * weight[:, None, :])
    freedom = np.maximum(usable.sum(axis=1) - PARAMETERS, 1)
    return Fitted(
        lines, origin + centre, amplitude, np.sqrt(inverses[:, 1, 1]), level, slope=slope / half, log_scale=log_scale,
        scale_sigma=np.sqrt(inverses[:, 2, 2]), chi2=np.sum(weight * residual**2, axis=1) / freedom,
        fisher=np.sqrt(inverses[:, 0, 0]), good=good & (amplitude > 0),
        x=(offset - centre[:, None]) * np.exp(-log_scale)[:, None], residual=residual, stripe=stripe,
        variance=np.where(usable, variance, np.inf), influence=influence,
    )  # fmt: skip


@compiled
def _improve(
    lines: NDArray[np.intp], table: tuple[float, float, Array, Array],
    pixels: tuple[Array, NDArray[np.bool_], Array, Array, Array, Array], noise: tuple[float, float],
    limits: tuple[float, float, float], found: Array, good: NDArray[np.bool_], going: NDArray[np.bool_],
    inverses: Array,
) -> None:  # fmt: skip  # pragma: no cover
    """One step of each of `lines` in `found` (m, PARAMETERS), its covariance before it in `inverses` (m, 5, 5).

    Lines that are not `going` get the covariance alone. `table` is the profile's first place, step, values and slopes,
    `pixels` the values, which are usable, shades, albedos, speckle (m, k) and the ramp (k,), `noise` floor and gain,
    `limits` the scale's precision, the largest step of the centre and half the window in px.
    """
    first, step, heights, rises = table
    value, usable, shade, albedo, speckle, ramp = pixels
    floor, gain = noise
    precision, limit, half = limits
    last = len(heights) - 1.000001
    row, right, scale, change = np.empty(5), np.empty(5), np.empty(5), np.empty(5)
    normal, lower = np.empty((5, 5)), np.empty((5, 5))
    for line in lines:
        now = found[line]
        amplitude, shrink = now[1], np.exp(-now[2])
        normal[:] = 0.0
        right[:] = 0.0
        for k in range(value.shape[1]):
            if not usable[line, k]:
                continue
            x = (half * ramp[k] - now[0]) * shrink
            place = min(max((x - first) / step, 0.0), last)
            at = int(place)
            part = place - at
            profile = (heights[at] + part * (heights[at + 1] - heights[at])) * albedo[line, k]
            rise = (rises[at] + part * (rises[at + 1] - rises[at])) * albedo[line, k]
            stripe = amplitude * profile
            mean = stripe + now[3] + now[4] * ramp[k]
            variance = floor + gain * max(mean + shade[line, k], 0.0) + speckle[line, k] * stripe * stripe
            row[0], row[1], row[2] = -amplitude * rise * shrink, profile, -amplitude * rise * x
            row[3], row[4] = 1.0, ramp[k]
            off = value[line, k] - mean
            for i in range(5):
                weighted = row[i] / variance
                right[i] += weighted * off
                for j in range(i + 1):
                    normal[i, j] += weighted * row[j]
        normal[2, 2] += precision
        right[2] -= precision * now[2]
        for i in range(5):
            scale[i] = np.sqrt(max(normal[i, i], 1e-30))
        # Cholesky's factor, and then its inverse in the same place.
        for i in range(5):
            for j in range(i + 1):
                total = normal[i, j] / (scale[i] * scale[j]) + (1e-9 if i == j else 0.0)
                for k in range(j):
                    total -= lower[i, k] * lower[j, k]
                lower[i, j] = np.sqrt(max(total, 1e-15)) if i == j else total / lower[j, j]
        for i in range(5):
            for j in range(i):
                total = 0.0
                for k in range(j, i):
                    total -= lower[i, k] * lower[k, j]
                lower[i, j] = total / lower[i, i]
            lower[i, i] = 1 / lower[i, i]
        inverse = inverses[line]
        for i in range(5):
            for j in range(i + 1):
                total = 0.0
                for k in range(i, 5):
                    total += lower[k, i] * lower[k, j]
                inverse[i, j] = inverse[j, i] = total / (scale[i] * scale[j])
        began = going[line]
        for i in range(5):
            total = 0.0
            for j in range(5):
                total += inverse[i, j] * right[j]
            change[i] = total if began else 0.0
        now[0] += min(max(change[0], -limit), limit)
        now[1] = min(max(amplitude + change[1], 0.2 * amplitude), 5 * amplitude + 1e-6)
        now[2] += min(max(change[2], -LARGEST_SCALE_STEP), LARGEST_SCALE_STEP)
        now[3] += change[3]
        now[4] += change[4]
        good[line] = good[line] and abs(now[0]) < half
        far = change[0] * change[0] > CONVERGED * CONVERGED * max(inverse[0, 0], 1e-8) or abs(change[2]) > 1e-3
        if not good[line]:
            now[0] = 0.0
        now[2] = min(max(now[2], -1.5), 1.5)
        going[line] = began and good[line] and far


def _model(
    offset: NDArray[np.intp], found: Array, shape: Shape, ramp: Array, albedo: Array
) -> tuple[Array, Array, Array]:
    """Stripe and mean (m, k) and the derivatives (m, PARAMETERS, k) by `found` (m, PARAMETERS): centre, amplitude,
    logarithm of the scale, level and slope."""
    centre, amplitude, log_scale, level, slope = found.T
    inverse = np.exp(-log_scale)[:, None]
    x = (offset - centre[:, None]) * inverse
    profile, rise = shape.at(x)
    profile, rise = profile * albedo, rise * albedo
    height = amplitude[:, None]
    jacobian = np.stack([-height * rise * inverse, profile, -height * rise * x, np.ones_like(x), ramp], axis=1)
    stripe = height * profile
    return stripe, jacobian, stripe + level[:, None] + slope[:, None] * ramp


def _linear_start(
    value: Array, usable: NDArray[np.bool_], offset: NDArray[np.intp], centre: Array, shape: Shape, ramp: Array
) -> tuple[Array, Array, Array]:
    """Amplitude, level and slope (m,) that fit best where the centre is as given, with the profile's own scale."""
    profile, _ = shape.at(offset - centre[:, None])
    basis = np.stack([profile, np.ones_like(ramp), ramp], axis=1) * usable[:, None, :]
    normal = basis @ np.swapaxes(basis, 1, 2) + 1e-6 * np.eye(3)
    right = np.einsum("mpk,mk->mp", basis, value)
    solved = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    return np.maximum(solved[:, 0], 1e-3), solved[:, 1], solved[:, 2]
