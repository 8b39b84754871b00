"""The edge of a dot, looked for along rays from its middle, and the ellipse through it.

A laser line across a dot spoils some rays and not its centre (docs/explanation/theory.md, section 6). Each dot is a
loop of its own, compiled: nothing is computed for rays of dots that stand still.
"""

import math

import numpy as np

from cell.base.compiled import compiled
from cell.measure.geometry.camera import Array
from cell.measure.vision.pictures import Image

RAYS = 32
RHO = np.linspace(0.15, 1.75, 33)
"""Where a ray is sampled, in radii."""
STEP = float(RHO[1] - RHO[0])
UNIT = np.column_stack([f(np.arange(RAYS) * 2 * np.pi / RAYS) for f in (np.cos, np.sin)])
DESIGN = np.column_stack([np.ones(RAYS), UNIT, UNIT[:, 0] ** 2 - UNIT[:, 1] ** 2, 2 * UNIT[:, 0] * UNIT[:, 1]])
"""A circle of the dot's own coordinates, shifted and stretched: its radius along each ray."""
TERMS = DESIGN.shape[1]
INSIDE, OUTSIDE, SEARCHED = (9, 13), (22, 29), (7, len(RHO) - 1)
"""Samples, from and to: in the dot from .6 to .75 radii, on the board from 1.25 to 1.55, and where its edge may be."""
MIDDLE, RIM, AROUND, DARK = (0, 4), (10, 14), (23, 29), (0, 27)
"""Those that tell a ring: its middle, its rim, the board around it, and what is dark of it."""
ORDER_OF_SEVEN = (
    (0, 5), (0, 3), (1, 6), (2, 4), (0, 1), (3, 5), (2, 6), (2, 3), (3, 6), (4, 5), (1, 4), (1, 3), (3, 4),
)  # fmt: skip
"""Pairs to be put in order so that the fourth of seven values is the middle one (Devillard 1998)."""
TURNS = 4
"""Of a fit, each with the weights of the one before."""
LEAST_SCATTER = 1e-3
"""Of the edge, in radii: less is not told from none."""
MOST_SCATTER = 0.15
SETTLED = 1e-4
"""Change of a dot's ellipse, in radii, with which it stands still."""
MOST_UNEVEN = 0.06
"""Share of the step from dot to board by which light that falls off evenly may depart from a plane."""
MOST_SLOPE = 0.3
WHITE_DN = 253


@compiled
def measure(image: Image, centres: Array, shapes: Array, rounds: int, sigma: Array, signs: Array) -> None:
    """Measure dots in place: `centres` (n, 2) in px and `shapes` (n, 2, 2), which map the unit circle to the ellipse.

    Gives one standard deviation (n,) of each centre in px, NaN for a dot whose edge is not seen all around, and as
    `signs` (n, 4) what tells a ring: middle, rim and board in DN, and the dot's darkness.
    """
    samples, edge, fit = np.empty((RAYS, len(RHO))), np.empty((2, RAYS)), np.empty(TERMS)
    for n in range(len(centres)):
        (a, b), (c, d) = shapes[n]
        x, y, deviation = centres[n, 0], centres[n, 1], math.nan
        # Beyond the board's horizon there is nothing to sample.
        if not math.isfinite(x + y + a + b + c + d):
            continue
        for _ in range(rounds):
            _sample(image, x, y, shapes[n], samples)
            _find_edge(samples, edge[0], edge[1])
            deviation = _fit(edge[0], edge[1], fit)
            if math.isnan(deviation):
                break
            change = abs(fit[0] - 1.0)
            fit[0] = min(max(fit[0], 0.5), 1.6)
            for i in range(1, TERMS):
                change = max(change, abs(fit[i]))
                fit[i] = min(max(fit[i], -0.5), 0.5)
            x, y = x + a * fit[1] + b * fit[2], y + c * fit[1] + d * fit[2]
            # A circle stretched by the second harmonic, in the dot's own coordinates.
            wide, high, skew = fit[0] + fit[3], fit[0] - fit[3], fit[4]
            a, b, c, d = a * wide + b * skew, a * skew + b * high, c * wide + d * skew, c * skew + d * high
            shapes[n, 0, 0], shapes[n, 0, 1], shapes[n, 1, 0], shapes[n, 1, 1] = a, b, c, d
            if change < SETTLED:
                break
        centres[n, 0], centres[n, 1] = x, y
        sigma[n] = deviation * math.sqrt(abs(a * d - b * c))
        _ring_signs(samples, signs[n])


@compiled
def _sample(image: Image, x: float, y: float, shape: Array, samples: Array) -> None:
    """Grey values (rays, samples) around a place in px, between pixels linearly; beyond the picture its border."""
    height, width = image.shape
    for k in range(RAYS):
        along = shape[0, 0] * UNIT[k, 0] + shape[0, 1] * UNIT[k, 1]
        down = shape[1, 0] * UNIT[k, 0] + shape[1, 1] * UNIT[k, 1]
        for s in range(len(RHO)):
            u = min(max(x + along * RHO[s], 0.0), width - 1.001)
            v = min(max(y + down * RHO[s], 0.0), height - 1.001)
            i, j = int(u), int(v)
            u, v = u - i, v - j
            upper = image[j, i] + u * (float(image[j, i + 1]) - image[j, i])
            lower = image[j + 1, i] + u * (float(image[j + 1, i + 1]) - image[j + 1, i])
            samples[k, s] = upper + v * (lower - upper)


@compiled
def _find_edge(samples: Array, edge: Array, seen: Array) -> None:
    """Where each ray leaves the dark, at half of the step, in radii; `seen` is 1 where it clearly does, else 0."""
    beyond, own, ring, beside = np.empty(RAYS), np.empty(RAYS), np.empty(RAYS), np.empty(7)
    for k in range(RAYS):
        beyond[k] = samples[k, OUTSIDE[0] : OUTSIDE[1]].mean()
        own[k] = samples[k, INSIDE[0] : INSIDE[1]].mean()
    # Neighbouring rays see the same board; a laser line or a neighbour dot does not move their median.
    for k in range(RAYS):
        for m in range(7):
            beside[m] = beyond[(k + m - 3) % RAYS]
        for first, second in ORDER_OF_SEVEN:
            one, other = beside[first], beside[second]
            beside[first], beside[second] = min(one, other), max(one, other)
        ring[k] = beside[3]
    dark = _median(own)
    slope = np.zeros(RAYS)
    even, mean = _slope_of_light(own, ring, slope), ring.mean()
    level, step = np.empty(RAYS), np.empty(RAYS)
    for k in range(RAYS):
        low = dark * (1.0 + slope[k])
        step[k] = (mean * (1.0 + slope[k]) if even else ring[k]) - low
        level[k] = low + 0.5 * step[k]
    least = max(0.4 * _median(step), 4.0)
    for k in range(RAYS):
        crossings, first = 0, 0
        for s in range(SEARCHED[0], SEARCHED[1]):
            if samples[k, s] < level[k] <= samples[k, s + 1]:
                crossings, first = crossings + 1, s if crossings == 0 else first
        seen[k] = 0 < crossings <= 2 and step[k] > least
        edge[k] = 1.0
        if seen[k]:
            low, high = samples[k, first], samples[k, first + 1]
            edge[k] = RHO[first] + (level[k] - low) / (high - low) * STEP


@compiled
def _slope_of_light(own: Array, ring: Array, slope: Array) -> bool:
    """By how much more light than its middle a dot's edge gets, a share (rays,), and whether light falls off evenly.

    `own` and `ring` (rays,) are the levels of the dot and of the board around it. The ring has the light of its own
    place, not that of the edge: taken as it is, it moves every dot of a board the same way, which no residual shows.
    """
    mean, dot = ring.mean(), own.mean()
    side = np.zeros((2, 2))
    for k in range(RAYS):
        for m in range(2):
            side[0, m] += 2.0 / RAYS * ring[k] * UNIT[k, m]
            side[1, m] += 2.0 / RAYS * own[k] * UNIT[k, m]
    uneven = 0.0
    for k in range(RAYS):
        uneven += (ring[k] - mean - side[0, 0] * UNIT[k, 0] - side[0, 1] * UNIT[k, 1]) ** 2 / RAYS
    if not math.sqrt(uneven) < MOST_UNEVEN * (mean - dot):
        return False
    # White that saturates tells nothing of the light; the dot, which reflects a little of it, does.
    told, of = side[0], 0.5 * (RHO[OUTSIDE[0]] + RHO[OUTSIDE[1] - 1]) * max(mean, 1.0)
    if ring.max() >= WHITE_DN:
        told, of = side[1], 0.5 * (RHO[INSIDE[0]] + RHO[INSIDE[1] - 1]) * max(dot, 1.0)
    for k in range(RAYS):
        slope[k] = min(max((told[0] * UNIT[k, 0] + told[1] * UNIT[k, 1]) / of, -MOST_SLOPE), MOST_SLOPE)
    return True


@compiled
def _fit(edge: Array, seen: Array, fit: Array) -> float:
    """Fit the Fourier terms (5,) of an edge, robustly: the deviation of its centre in radii, NaN where rays miss."""
    weight, residual, z, away = seen.copy(), np.empty(RAYS), np.empty(RAYS), np.empty(RAYS)
    scatter = 1.0
    if seen.sum() < RAYS // 2:
        return math.nan
    for _ in range(TURNS):
        _solve(edge, weight, fit)
        for k in range(RAYS):
            residual[k] = edge[k]
            for i in range(TERMS):
                residual[k] -= DESIGN[k, i] * fit[i]
            away[k] = abs(residual[k]) if seen[k] > 0.5 else math.inf
        scatter = 1.4826 * _median(away)
        scatter = max(scatter if math.isfinite(scatter) else 1.0, LEAST_SCATTER)
        for k in range(RAYS):
            z[k] = residual[k] / (4.0 * scatter)
            weight[k] = (1.0 - z[k] * z[k]) ** 2 if seen[k] > 0.5 and abs(z[k]) < 1.0 else 0.0
    if not (_surround(weight) and scatter < MOST_SCATTER):
        return math.nan
    # The variance of an M-estimator: the mean square of what each ray pulls over the square of how stiffly it holds.
    pulled = held = within = 0.0
    for k in range(RAYS):
        if weight[k] > 0.0:
            pulled += (weight[k] * residual[k]) ** 2
            held += (1.0 - z[k] ** 2) * (1.0 - 5.0 * z[k] ** 2)
            within += 1.0
    freedom = max(within - TERMS, 1.0) / max(within, 1.0)
    return math.sqrt(2.0 * pulled / max(held, 1.0) ** 2 / freedom)


@compiled
def _surround(weight: Array) -> bool:
    """Whether half of the rays count, and leave no gap of a third of the circle."""
    used = gap = longest = 0
    for k in range(2 * RAYS):
        counts = weight[k % RAYS] > 0.2
        used += counts and k < RAYS
        gap = 0 if counts else gap + 1
        longest = max(longest, gap)
    return used >= RAYS // 2 and longest <= RAYS // 3


@compiled
def _median(values: Array) -> float:
    """The median of values (n,), by counting: nothing to be guessed by a processor that looks ahead."""
    lower = upper = math.nan
    below, above = (len(values) - 1) // 2, len(values) // 2
    for value in values:
        less = least = 0
        for other in values:
            less += other < value
            least += other <= value
        lower = value if less <= below < least else lower
        upper = value if less <= above < least else upper
    return 0.5 * (lower + upper)


@compiled
def _solve(edge: Array, weight: Array, fit: Array) -> None:
    """The weighted least squares of the Fourier terms (5,), by Cholesky's factors of their normal matrix."""
    factor, right = np.zeros((TERMS, TERMS)), np.zeros(TERMS)
    for k in range(RAYS):
        for i in range(TERMS):
            right[i] += weight[k] * edge[k] * DESIGN[k, i]
            for j in range(i + 1):
                factor[i, j] += weight[k] * DESIGN[k, i] * DESIGN[k, j]
    for i in range(TERMS):
        factor[i, i] += 1e-9
        for j in range(i + 1):
            for m in range(j):
                factor[i, j] -= factor[i, m] * factor[j, m]
            factor[i, j] = math.sqrt(factor[i, i]) if i == j else factor[i, j] / factor[j, j]
        for m in range(i):
            right[i] -= factor[i, m] * right[m]
        right[i] /= factor[i, i]
    for i in range(TERMS - 1, -1, -1):
        for m in range(i + 1, TERMS):
            right[i] -= factor[m, i] * fit[m]
        fit[i] = right[i] / factor[i, i]


@compiled
def _ring_signs(samples: Array, signs: Array) -> None:
    """What tells a ring, (4,): the middle, the rim and the board in DN, and how much of the dot is dark, in radii²."""
    rays = np.empty((4, RAYS))
    for k in range(RAYS):
        rays[0, k] = samples[k, MIDDLE[0] : MIDDLE[1]].mean()
        rays[1, k] = samples[k, RIM[0] : RIM[1]].min()
        rays[2, k] = samples[k, AROUND[0] : AROUND[1]].mean()
    signs[2] = bright = _median(rays[2])
    for k in range(RAYS):
        rays[3, k] = ((bright - samples[k, DARK[0] : DARK[1]]) * RHO[DARK[0] : DARK[1]]).sum() / max(bright, 1.0)
    signs[0], signs[1], signs[3] = _median(rays[0]), _median(rays[1]), _median(rays[3])
