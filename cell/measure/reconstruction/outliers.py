"""Points of an organised cloud that do not lie on the surface around them.

The depth of each point is compared with the median of its 5×5 neighbours (line × row), in units of its noise and of
the deviations around it, so that near outliers and streaks stand out (docs/explanation/theory.md, section 7). Compiled.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scipy
from numpy.typing import NDArray

from cell.base.compiled import compiled

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

THRESHOLD = 6.5
"""Deviation, in median absolute deviations, from which on a point is an outlier.

The deviation is the lesser of two, so its median is less than a normal variable's: of white noise this is 4.1 σ.
"""
LEAST_LEVEL = 0.25
"""Smallest median absolute deviation that is taken for the noise, in units of the noise stated."""
LEAST_NEIGHBOURS = 6
"""A point with fewer neighbours in its window is rejected: nothing supports it."""
SCALE_OF_QUARTILE = 1.5
"""The local scale is so many lower quartiles of the deviations around: streaks on both sides spoil their median."""
FEW_PAIRS = 5
"""With fewer pairs of opposite neighbours the slope is also continued from one side."""
LEAST_PAIRS = 3
"""With fewer values for the slope only the median of all neighbours is used."""
MOST_PAIRS = 12
"""There are never more values for the slope."""


def find_outliers(depth: NDArray[np.floating], sigma: NDArray[np.floating]) -> NDArray[np.bool_]:
    """True (lines, rows) for outliers of `depth` (lines, rows) in m, NaN for holes; `sigma` is its noise in m.
    Deviations are weighed by `sigma`. What a first pass finds is left out of the medians of a second one."""
    values = np.array(depth, dtype=np.float64)
    noise = np.array(sigma, dtype=np.float64)
    measured = np.isfinite(values)
    outliers = np.zeros(values.shape, dtype=np.bool_)
    if not measured.any():
        return outliers
    noise = np.where(measured, np.maximum(noise, 0.2 * float(np.median(noise[measured]))), 1.0)
    level = _level(values, noise)
    first, settled = _pass(values, values, noise, level, np.zeros(values.shape, dtype=np.bool_))
    # A point that its neighbours supported stays supported unless one of them was found to be an outlier.
    settled &= ~scipy.ndimage.maximum_filter(first, size=5)
    return _pass(values, np.where(first, np.nan, values), noise, level, settled)[0]


def _pass(values: Array, kept: Array, noise: Array, level: float, settled: Mask) -> tuple[Mask, Mask]:
    """Outliers with respect to the `kept` values, and the points that their neighbours supported; those `settled` are
    not looked at. Two threads take half of the lines each; what ends either of them ends the pass."""
    outliers = np.zeros(values.shape, dtype=np.bool_)
    supported = settled.copy()
    middle = len(values) // 2
    with ThreadPoolExecutor(1, "outliers") as pool:
        other = pool.submit(
            _judge, values, kept, noise, level=level, first=middle, last=len(values), supported=supported,
            outliers=outliers,
        )  # fmt: skip
        _judge(values, kept, noise, level=level, first=0, last=middle, supported=supported, outliers=outliers)
        other.result()
    return outliers, supported


def _level(values: Array, noise: Array) -> float:
    """Median absolute deviation over the whole cloud, in units of the noise, from every few lines and rows. At least
    `LEAST_LEVEL`: nothing is an outlier that lies within the noise that was stated for it."""
    deviations = _sampled(values, noise, 3 if values.size < 20_000 else 7)
    found = deviations[np.isfinite(deviations)]
    return max(LEAST_LEVEL, float(np.median(np.abs(found)))) if len(found) else 1.0


@compiled
def _sort(buffer: Array, count: int) -> None:
    """Sort the first `count` values of `buffer` in place, by insertion: they are few."""
    for i in range(1, count):
        value, j = buffer[i], i - 1
        while j >= 0 and buffer[j] > value:
            buffer[j + 1] = buffer[j]
            j -= 1
        buffer[j + 1] = value


@compiled
def _median(buffer: Array, count: int) -> float:
    """Median of the first `count` values of `buffer`, which are sorted in place."""
    _sort(buffer, count)
    return float(0.5 * (buffer[(count - 1) // 2] + buffer[count // 2]))


@compiled
def _gather(values: Array, line: int, row: int, buffer: Array) -> int:
    """The finite values of the 5×5 window around (line, row), without its middle, into `buffer`; their number."""
    count = 0
    for i in range(max(0, line - 2), min(values.shape[0], line + 3)):
        for j in range(max(0, row - 2), min(values.shape[1], row + 3)):
            value = values[i, j]
            if (i != line or j != row) and not np.isnan(value):
                buffer[count] = value
                count += 1
    return count


@compiled
def _gather_pairs(values: Array, line: int, row: int, buffer: Array) -> int:
    """What a slope through the neighbours says of (line, row), into `buffer`; the number of such values.

    The means of neighbours opposite each other; where these are few, at a border or beside a hole, also the lines
    through two neighbours that lie behind each other.
    """
    count = 0
    inside = 2 <= line < values.shape[0] - 2 and 2 <= row < values.shape[1] - 2
    for i in range(-2, 1):
        for j in range(-2, 3):
            if i == 0 and j >= 0:
                break
            if inside:
                mean = 0.5 * (values[line + i, row + j] + values[line - i, row - j])
            else:
                mean = 0.5 * (_at(values, line + i, row + j) + _at(values, line - i, row - j))
            if not np.isnan(mean):
                buffer[count] = mean
                count += 1
    if count < FEW_PAIRS:
        for i in range(-1, 2):
            for j in range(-1, 2):
                beyond = 2.0 * _at(values, line + i, row + j) - _at(values, line + 2 * i, row + 2 * j)
                if (i != 0 or j != 0) and not np.isnan(beyond):
                    buffer[count] = beyond
                    count += 1
    return count


@compiled
def _at(values: Array, line: int, row: int) -> float:
    """The value there, NaN beyond the border."""
    if 0 <= line < values.shape[0] and 0 <= row < values.shape[1]:
        return float(values[line, row])
    return np.nan


@compiled
def _deviation(values: Array, kept: Array, noise: Array, line: int, row: int, buffer: Array) -> float:
    """How far a value lies off the kept ones around it, in units of its noise; NaN where too few are around.

    Off their median, which an edge does not mislead, or off the median of opposite pairs, which a slope does not
    mislead: whichever is less.
    """
    count = _gather(kept, line, row, buffer)
    if count < LEAST_NEIGHBOURS:
        return np.nan
    own = values[line, row]
    off = own - _median(buffer, count)
    count = _gather_pairs(kept, line, row, buffer)
    if count >= LEAST_PAIRS:
        off_pairs = own - _median(buffer, count)
        if abs(off_pairs) < abs(off):
            off = off_pairs
    return float(off / noise[line, row])


@compiled
def _sampled(values: Array, noise: Array, stride: int) -> Array:
    """Deviations of every `stride`-th place."""
    result = np.full((values.shape[0] // stride + 1, values.shape[1] // stride + 1), np.nan)
    buffer = np.empty(25)
    for i in range(0, values.shape[0], stride):
        for j in range(0, values.shape[1], stride):
            if not np.isnan(values[i, j]):
                result[i // stride, j // stride] = _deviation(values, values, noise, line=i, row=j, buffer=buffer)
    return result


@compiled
def _supported(values: Array, kept: Array, reach: float, line: int, row: int, buffer: Array) -> bool:
    """True when over half of the neighbours, or of their pairs, lie within `reach`: then so does their median."""
    value = values[line, row]
    if 2 <= line < values.shape[0] - 2 and 2 <= row < values.shape[1] - 2:
        # Most points are done with as soon as more pairs are near than could be half of them.
        near = 0
        for i in range(-2, 1):
            for j in range(-2, 3 if i < 0 else 0):
                mean = 0.5 * (kept[line + i, row + j] + kept[line - i, row - j])
                near += abs(mean - value) <= reach
                if 2 * near > MOST_PAIRS:
                    return True
    count = _gather_pairs(kept, line, row, buffer)
    if count >= LEAST_PAIRS:
        near = 0
        for k in range(count):
            near += abs(buffer[k] - value) <= reach
        if 2 * near > count:
            return True
    count = _gather(kept, line, row, buffer)
    near = 0
    for k in range(count):
        near += abs(buffer[k] - value) <= reach
    return bool(count >= LEAST_NEIGHBOURS and 2 * near > count)


@compiled
def _quiet_around(values: Array, kept: Array, noise: Array, most: float, line: int, row: int, buffer: Array) -> bool:
    """True when the lower quartile of the deviations around is surely less than `most`: counted without a sort."""
    present, near = 0, 0
    for i in range(max(0, line - 2), min(values.shape[0], line + 3)):
        for j in range(max(0, row - 2), min(values.shape[1], row + 3)):
            present += (i != line or j != row) and not np.isnan(kept[i, j])
    for i in range(max(0, line - 2), min(values.shape[0], line + 3)):
        for j in range(max(0, row - 2), min(values.shape[1], row + 3)):
            if (i != line or j != row) and not np.isnan(kept[i, j]):
                near += _supported(kept, kept, most * noise[i, j], line=i, row=j, buffer=buffer)
                if near > present // 4:
                    return True
    return False


@compiled
def _local_scale(sizes: Array, count: int, level: float) -> float:
    """That of the first `count` deviations, by their quartile; at least the global `level`."""
    if count == 0:
        return level
    _sort(sizes, count)
    scale: float = max(level, SCALE_OF_QUARTILE * sizes[count // 4])
    return scale


@compiled
def _judge(
    values: Array, kept: Array, noise: Array, level: float, first: int, last: int, supported: Mask, outliers: Mask
) -> None:
    """Mark in lines `first` to `last` what is further off the `kept` ones than so many local or global scales."""
    known = np.full((last - first + 4, values.shape[1]), np.inf)
    buffer, sizes = np.empty(25), np.empty(25)
    for line in range(first, last):
        for row in range(values.shape[1]):
            if supported[line, row] or np.isnan(values[line, row]):
                continue
            if _supported(values, kept, THRESHOLD * level * noise[line, row], line=line, row=row, buffer=buffer):
                supported[line, row] = True
                continue
            own = _deviation(values, kept, noise, line=line, row=row, buffer=buffer)
            if np.isnan(own):
                outliers[line, row] = True
                continue
            if _quiet_around(
                values, kept, noise, most=abs(own) / (THRESHOLD * SCALE_OF_QUARTILE), line=line, row=row, buffer=buffer
            ):
                outliers[line, row] = abs(own) > THRESHOLD * level
                continue
            count = 0
            for i in range(max(0, line - 2), min(values.shape[0], line + 3)):
                for j in range(max(0, row - 2), min(values.shape[1], row + 3)):
                    if (i == line and j == row) or np.isnan(kept[i, j]):
                        continue
                    if known[i - first + 2, j] == np.inf:
                        known[i - first + 2, j] = abs(_deviation(kept, kept, noise, line=i, row=j, buffer=buffer))
                    if not np.isnan(known[i - first + 2, j]):
                        sizes[count] = known[i - first + 2, j]
                        count += 1
            outliers[line, row] = abs(own) > THRESHOLD * _local_scale(sizes, count, level)
