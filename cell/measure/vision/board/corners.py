"""Places of chessboard corners to some hundredths of a pixel, each with its own standard deviation.

A corner is two crossing edges of a blurred, unevenly lit picture: (1 + g·p)·(m + c·erf(d₁)·erf(d₂)). Least squares on
all pixels around it, with what does not fit (a laser line, a finger) left out; this attains the bound for white noise.
The deviation comes from what each pixel leaves, as bright ones are noisier than dark ones.
"""

import math

import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.geometry.camera import Array
from cell.measure.vision.pictures import Image

PARAMETERS = 10
STEPS = 30
# Window as a share of the shorter distance to the next corner, and its limits in px.
WINDOW_SHARE = 0.42
WINDOW_PX = (3.2, 13.0)
OUTLYING = 4.5
# Largest change of the light, from the corner to the window's rim.
LIGHT_CHANGE = 0.7
WHITE_DN = 253


def fit_corners(
    image: Image, starts: Array, steps: Array, dark_first: NDArray[np.bool_], share: float = WINDOW_SHARE
) -> tuple[Array, Array, Array]:
    """Corners (n, 2) in px near `starts` (n, 2), one standard deviation (n,) in px, and contrasts (n,) in DN.

    `steps` (n, 2, 2) are the columns towards the next corner along x and along y in px. `dark_first` (n,) says whether
    the square between +x and +y is dark; `share`
    is the window's radius as a share of the distance to the next corner. Corners that are not there get NaN.
    """
    places = np.empty((len(starts), 2))
    sigma = np.empty(len(starts))
    contrast = np.empty(len(starts))
    _fit(
        np.ascontiguousarray(image), np.ascontiguousarray(starts, dtype=np.float64),
        np.ascontiguousarray(steps, dtype=np.float64), dark_first=np.ascontiguousarray(dark_first), share=share,
        places=places, sigma=sigma, contrast=contrast,
    )  # fmt: skip
    return places, sigma, contrast


@compiled
def _fit(
    image: Image, starts: Array, steps: Array, dark_first: NDArray[np.bool_], share: float, places: Array, sigma: Array,
    contrast: Array,
) -> None:  # pragma: no cover  # fmt: skip
    for n in range(len(starts)):
        first = math.hypot(steps[n, 0, 0], steps[n, 1, 0])
        second = math.hypot(steps[n, 0, 1], steps[n, 1, 1])
        cross = abs(steps[n, 0, 0] * steps[n, 1, 1] - steps[n, 0, 1] * steps[n, 1, 0])
        side = cross / max(first, second, 1e-9)
        reach = min(max(share * side, WINDOW_PX[0]), WINDOW_PX[1])
        places[n, 0] = places[n, 1] = sigma[n] = contrast[n] = np.nan
        angle_1 = math.atan2(steps[n, 1, 0], steps[n, 0, 0])
        angle_2 = math.atan2(steps[n, 1, 1], steps[n, 0, 1])
        _one(
            image, starts[n], reach, angle_1=angle_1, angle_2=angle_2, dark=dark_first[n], n=n, places=places,
            sigma=sigma, contrast=contrast,
        )  # fmt: skip


@compiled
def _one(
    image: Image, start: Array, reach: float, angle_1: float, angle_2: float, dark: bool, n: int, places: Array,
    sigma: Array, contrast: Array,
) -> None:  # pragma: no cover  # fmt: skip
    height, width = image.shape
    u0, v0 = int(start[0] + 0.5), int(start[1] + 0.5)
    half = int(reach) + 1
    if not (half <= u0 < width - half and half <= v0 < height - half):
        return
    count = 0
    size = 2 * half + 1
    du, dv, grey = np.empty(size * size), np.empty(size * size), np.empty(size * size)
    for v in range(-half, half + 1):
        for u in range(-half, half + 1):
            if u * u + v * v <= reach * reach:
                du[count], dv[count], grey[count] = u, v, image[v0 + v, u0 + u]
                count += 1
    low, high, mean = 1e9, -1e9, 0.0
    for k in range(count):
        low, high, mean = min(low, grey[k]), max(high, grey[k]), mean + grey[k] / count
    # The sector between the two steps is on the positive side of one line and the negative side of the other.
    turn = math.sin(angle_2 - angle_1)
    sign = (1.0 if dark else -1.0) * (1.0 if turn > 0 else -1.0)
    p = np.array([start[0] - u0, start[1] - v0, angle_1, angle_2, 1.0, 1.0, mean, sign * 0.4 * (high - low), 0.0, 0.0])
    weight = np.ones(count)
    damping, total, scale = 1e-3, 1e300, 1e9
    residual = np.empty(count)
    best = p.copy()
    normal = np.zeros((PARAMETERS, PARAMETERS))
    row = np.empty(PARAMETERS)
    for step in range(STEPS):
        new_normal = np.zeros((PARAMETERS, PARAMETERS))
        right = np.zeros(PARAMETERS)
        squares, mass = 0.0, 0.0
        for k in range(count):
            modelled = _model(p, du[k], dv[k], row)
            residual[k] = grey[k] - modelled
            if grey[k] >= WHITE_DN and modelled > grey[k]:
                # A saturated pixel only says that the light was at least that.
                residual[k] = 0.0
                continue
            w = weight[k]
            squares += w * residual[k] ** 2
            mass += w
            for i in range(PARAMETERS):
                right[i] += w * row[i] * residual[k]
                for j in range(i + 1):
                    new_normal[i, j] += w * row[i] * row[j]
        if squares / max(mass, 1e-9) <= total:
            gain = total - squares / max(mass, 1e-9)
            total = squares / max(mass, 1e-9)
            best[:] = p
            for i in range(PARAMETERS):
                for j in range(i + 1):
                    normal[i, j] = normal[j, i] = new_normal[i, j]
            damping = max(0.1 * damping, 1e-7)
            if step in (3, 5, 7):
                scale = 1.4826 * np.median(np.abs(residual)) + 0.3
                kept = 0.0
                for k in range(count):
                    z = residual[k] / (OUTLYING * scale)
                    weight[k] = (1 - z * z) ** 2 if abs(z) < 1 else 0.0
                    kept += weight[k]
                if kept < 0.45 * count:
                    return
                total = 1e300
            elif step > 7 and gain < 1e-5 * total:
                break
        else:
            damping *= 10
        damped = normal.copy()
        for i in range(PARAMETERS):
            damped[i, i] += damping * normal[i, i] + 1e-6
        if step < STEPS - 1:
            if total >= 1e300:
                for i in range(PARAMETERS):
                    for j in range(i + 1):
                        damped[i, j] = damped[j, i] = new_normal[i, j]
                    damped[i, i] = new_normal[i, i] * (1 + damping) + 1e-6
            if not (math.isfinite(squares) and np.isfinite(right).all()):
                return
            move = np.linalg.solve(damped, right)
            for i in range(2):
                move[i] = min(max(move[i], -0.3 * reach), 0.3 * reach)
                move[2 + i] = min(max(move[2 + i], -0.2), 0.2)
            p = best + move if total < 1e300 else p + move
            p[6], p[7] = min(max(p[6], -300.0), 900.0), min(max(p[7], -900.0), 900.0)
            p[4], p[5] = min(max(p[4], 0.25), 0.8 * reach), min(max(p[5], 0.25), 0.8 * reach)
            steepest = LIGHT_CHANGE / reach
            p[8], p[9] = min(max(p[8], -steepest), steepest), min(max(p[9], -steepest), steepest)
    moved = math.hypot(best[0] + u0 - start[0], best[1] + v0 - start[1])
    crossing = abs(math.sin(best[3] - best[2]))
    if moved > 0.75 * reach or crossing < 0.17 or best[7] * sign <= 0 or total >= 1e300:
        return
    for angle, begin in ((best[2], angle_1), (best[3], angle_2)):
        if abs(math.sin(angle - begin)) > 0.35:
            return
    variance = total * count / max(count - PARAMETERS, 1)
    if abs(best[7]) < 1.2 * math.sqrt(variance) or abs(best[7]) < 2.0:
        return
    # What the model leaves must be noise: a corner half hidden keeps a residual of the size of its contrast.
    if math.sqrt(variance) > 0.3 * abs(best[7]) + 1.0 and scale > 0.3 * abs(best[7]) + 1.0:
        return
    places[n, 0], places[n, 1] = best[0] + u0, best[1] + v0
    sigma[n] = _deviation(best, du[:count], dv[:count], grey=grey[:count], used=weight > 0, limit=OUTLYING * scale)
    contrast[n] = 2 * abs(best[7])


@compiled
def _model(p: Array, u: float, v: float, row: Array) -> float:  # pragma: no cover
    """Grey value at (u, v) px from the middle of the window; its derivatives by the parameters go into `row`."""
    c1, s1, c2, s2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    x, y = u - p[0], v - p[1]
    d1, d2 = x * -s1 + y * c1, x * -s2 + y * c2
    e1, e2 = math.erf(d1 / (1.41421356 * p[4])), math.erf(d2 / (1.41421356 * p[5]))
    light = 1.0 + p[8] * u + p[9] * v
    a = light * p[7] * e2 * 0.79788456 / p[4] * math.exp(-0.5 * (d1 / p[4]) ** 2)
    b = light * p[7] * e1 * 0.79788456 / p[5] * math.exp(-0.5 * (d2 / p[5]) ** 2)
    pattern = p[6] + p[7] * e1 * e2
    row[0], row[1] = a * s1 + b * s2, -a * c1 - b * c2
    row[2], row[3] = a * (-x * c1 - y * s1), b * (-x * c2 - y * s2)
    row[4], row[5] = -a * d1 / p[4], -b * d2 / p[5]
    row[6], row[7], row[8], row[9] = light, light * e1 * e2, u * pattern, v * pattern
    return float(light * pattern)


@compiled
def _deviation(
    p: Array, du: Array, dv: Array, grey: Array, used: NDArray[np.bool_], limit: float
) -> float:  # pragma: no cover
    """One standard deviation of the corner's coordinates in px: that of an M-estimator whose pixels differ in noise.
    `used` are the pixels (n,) that count, those beyond `limit` DN do not."""
    slope = np.zeros((PARAMETERS, PARAMETERS))
    spread = np.zeros((PARAMETERS, PARAMETERS))
    row = np.empty(PARAMETERS)
    count = 0
    for k in range(len(grey)):
        modelled = _model(p, du[k], dv[k], row)
        z = (grey[k] - modelled) / limit
        if not used[k] or abs(z) >= 1 or (grey[k] >= WHITE_DN and modelled > grey[k]):
            continue
        count += 1
        bend = (1 - z * z) * (1 - 5 * z * z)
        square = (z * limit * (1 - z * z) ** 2) ** 2
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                slope[i, j] += bend * row[i] * row[j]
                spread[i, j] += square * row[i] * row[j]
    if count <= PARAMETERS:
        return np.nan
    for i in range(PARAMETERS):
        slope[i, i] += 1e-9
    inverse = np.linalg.inv(slope)
    covariance = inverse @ spread @ inverse.T
    share = count / (count - PARAMETERS)
    return math.sqrt(0.5 * share * max(covariance[0, 0] + covariance[1, 1], 0.0))
