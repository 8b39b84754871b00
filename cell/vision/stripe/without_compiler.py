"""`stripe_search.py` and `stripe_fit.py` without a compiler: the same rules, all lines at once.

For machines where numba does not run, and as an independent check of the compiled loops. About twenty times slower.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.vision.stripe import find as find
from cell.vision.stripe import fit as fit
from cell.vision.stripe import lanes as lane

CHUNK = 256


def find_lines(
    image: Any, seen: Any, dark: Any, saturation: int, least_peak: float, start: Any, _cut: Any, _cut_at: Any
) -> bool:
    """As `stripe_search.find_lines`, but for what that one keeps for the fit, which here has no use for it."""
    lines = np.arange(len(image))
    place = seen.argmax(axis=1)
    lines, place = _with(seen[lines, place] >= least_peak, lines, place)
    low, high = place.copy(), place.copy()
    peak = place.copy()
    open_ = np.ones(len(lines), dtype=np.bool_)
    for attempt in range(find.TRIES):
        here = np.flatnonzero(open_)
        if not len(here):
            break
        if attempt:
            low[here] = np.minimum(low[here], peak[here] - 4)
            high[here] = np.maximum(high[here], peak[here] + 4)
            peak[here] = _prominent(seen[lines[here]], low[here], high[here])
            open_[here[peak[here] < 0]] = False
            here = here[peak[here] >= 0]
        record, good = _measure(image, dark, lines[here], peak[here], saturation, least_peak)
        start[lines[here[good]], 0] = record[good]
        open_[here[good]] = False
    there = start[lines, 0, find.ENERGY] > 0
    lines, peak = _with(there, lines, peak)
    best = start[lines, 0]
    reach = np.maximum(4.0, 4.0 * best[:, find.WIDTH]).astype(int) + 1 + best[:, find.CORE].astype(int)
    low, high = peak - reach, peak + reach
    column = np.arange(seen.shape[1])
    inside = (column >= low[:, None]) & (column <= high[:, None])
    elsewhere = np.where(inside, 0, seen[lines]).max(axis=1)
    rival = elsewhere >= best[:, find.BACKGROUND] + np.maximum(least_peak, find.RIVAL * best[:, find.HEIGHT])
    lines, low, high = _with(rival, lines, low, high)
    place = _prominent(seen[lines], low, high)
    lines, place = _with(place >= 0, lines, place)
    record, good = _measure(image, dark, lines, place, saturation, least_peak)
    lines, record = lines[good], record[good]
    start[lines, 1] = record
    more = lines[record[:, find.ENERGY] > start[lines, 0, find.ENERGY]]
    start[more] = start[more, ::-1]
    return len(lines) > 0


def _with(mask: Any, *arrays: Any) -> Any:
    return tuple(array[mask] for array in arrays)


def _prominent(rows: Any, low: Any, high: Any) -> Any:
    """Where a pixel outside low … high stands farthest above its neighbours at ±SEARCH; −1 when none does."""
    if not len(rows):
        return np.zeros(0, dtype=int)
    value = rows.astype(np.int16)
    s = find.SEARCH
    rise = value[:, s:-s] - np.maximum(value[:, : -2 * s], value[:, 2 * s :])
    column = np.arange(s, rows.shape[1] - s)
    rise[(column >= low[:, None]) & (column <= high[:, None])] = 0
    place = rise.argmax(axis=1)
    return np.where(rise[np.arange(len(rows)), place] > 0, place + s, -1)


def _measure(image: Any, dark: Any, lines: Any, place: Any, saturation: int, least_peak: float) -> tuple[Any, Any]:
    """Start values (m, START) of the peaks at `place` and whether each stands out from both its sides."""
    n = image.shape[1]
    core_low, core_high = place.copy(), place.copy()
    core = np.zeros(len(lines))
    for k in np.flatnonzero(image[lines, place] >= saturation):
        under = np.flatnonzero(image[lines[k]] < saturation)
        at = np.searchsorted(under, place[k])
        core_low[k] = under[at - 1] + 1 if at > 0 else 0
        core_high[k] = under[at] - 1 if at < len(under) else n - 1
        core[k] = core_high[k] - core_low[k] + 1
    low, high = np.maximum(0, core_low - find.SEARCH), np.minimum(n - 1, core_high + find.SEARCH)
    offset = np.arange(int((high - low).max()) + 1) if len(lines) else np.arange(1)
    column = low[:, None] + offset
    inside = column <= high[:, None]
    column = np.minimum(column, n - 1)
    value = image[lines[:, None], column].astype(np.float64)
    if len(dark) > 1:
        value -= dark[lines[:, None], column]
    row = np.arange(len(lines))
    left = value[:, :4].mean(axis=1)
    right = np.mean([value[row, high - low - k] for k in range(4)], axis=0) if len(lines) else left
    peak = value[row, place - low]
    background = 0.5 * (left + right)
    half = background + 0.5 * (peak - background)
    floor = background + 0.2 * (peak - background)
    over = np.where(inside, np.maximum(value - floor[:, None], 0.0), 0.0)
    above = np.sum(inside & (value > half[:, None]), axis=1)
    total = np.sum(np.where(inside, value - background[:, None], 0.0), axis=1)
    energy = np.maximum(over.sum(axis=1), 1e-12)
    clipped = np.sqrt(np.maximum(above**2 - core**2, 2.0) / 5.545)
    record = np.empty((len(lines), find.START))
    record[:, find.CENTRE] = low + (over @ offset) / energy
    record[:, find.WIDTH] = np.where(core > 1, clipped, np.maximum(above, 1.0) / 2.355)
    record[:, find.HEIGHT] = peak - background
    record[:, find.BACKGROUND] = background
    record[:, find.ENERGY] = np.maximum(total, 1e-6)
    record[:, find.CORE] = core
    return record, peak - np.maximum(left, right) >= least_peak


def fit_lines(
    image: Any, _cut: Any, _cut_at: Any, dark: Any, start: Any, widths: Any, log_widths: Any, which: Any,
    saturation: int, noise: Any, dark_noise: Any, rho: Any, steps: int, out: Any,
) -> None:  # fmt: skip
    """As `stripe_fit.fit_lines`."""
    for k in range(0, len(which), CHUNK):
        lines = which[k : k + CHUNK]
        shade = dark[lines] if len(dark) > 1 else None
        variances = noise[0], noise[1], noise[2] ** 2
        one = start[lines, 0], widths[lines], log_widths[lines], lines
        _fit(image[lines], shade, *one, saturation, variances, rho, dark_noise, steps, out)


def _fit(
    image: Any, shade: Any, start: Any, widths: Any, expected: Any, lines: Any, saturation: int, noise: Any,
    rho: Any, dark_noise: Any, steps: int, out: Any,
) -> None:  # fmt: skip
    """The lines of one chunk."""
    core = start[:, find.CORE]
    clipped = core > 1
    origin = np.floor(start[:, find.CENTRE] + fit.NEAREST).astype(int)
    reach = np.minimum(lane.HALF, 0.5 * core + 4.0 * widths + 3.0).astype(int)
    x = np.arange(-int(reach.max()), int(reach.max()) + 1)
    column = origin[:, None] + x
    usable = (np.abs(x) <= reach[:, None]) & (column >= 0) & (column < image.shape[1])
    column = np.clip(column, 0, image.shape[1] - 1)
    raw = np.take_along_axis(image, column, axis=1)
    usable &= raw < saturation
    value, extra = raw.astype(np.float64), np.zeros(raw.shape)
    if shade is not None:
        below = np.take_along_axis(shade, column, axis=1).astype(np.float64)
        value -= below
        extra = dark_noise[0] + dark_noise[1] * below
    prior = np.where(clipped, fit.CLIPPED_PRIOR, fit.WIDTH_PRIOR) ** -2.0
    amplitude = start[:, find.HEIGHT].copy()
    amplitude[clipped] *= np.exp(np.minimum(4.0, 0.5 * (0.5 * core / widths)[clipped] ** 2))
    at = np.column_stack(
        [start[:, find.CENTRE] - origin, amplitude, expected, start[:, find.BACKGROUND], np.zeros(len(lines))]
    )
    active = np.ones(len(lines))
    chi2 = np.zeros(len(lines))
    good = usable.sum(axis=1) > fit.PARAMETERS
    row = np.zeros((len(lines), fit.PARAMETERS))
    for _ in range(steps):
        mean, stripe, jacobian = _model(at, x)
        weight = usable / (noise[0] + np.maximum(noise[1] * mean, 0.0) + noise[2] * stripe**2 + extra)
        residual = value - mean
        weighted = jacobian * weight[:, :, None]
        normal = np.swapaxes(jacobian, 1, 2) @ weighted
        right = np.einsum("lxp,lx->lp", weighted, residual)
        normal[:, 2, 2] += prior
        right[:, 2] += prior * (expected - at[:, 2])
        good &= np.linalg.eigvalsh(normal)[:, 0] > 1e-12
        normal[~good] = np.eye(fit.PARAMETERS)
        inverse = np.linalg.inv(normal)
        step = np.einsum("lpq,lq->lp", inverse, right)
        row += active[:, None] * (inverse[:, 0] - row)
        chi2 += active * (np.sum(weight * residual**2, axis=1) - np.sum(step * right, axis=1) - chi2)
        changed = np.clip(at[:, 1] + step[:, 1], 0.3 * at[:, 1], 3.0 * at[:, 1])
        at[:, 0] += active * np.clip(step[:, 0], -lane.LARGEST_STEP, lane.LARGEST_STEP)
        at[:, 1] += active * (changed - at[:, 1])
        at[:, 2] += active * np.clip(step[:, 2], -lane.LARGEST_WIDTH_STEP, lane.LARGEST_WIDTH_STEP)
        at[:, 3:] += active[:, None] * step[:, 3:]
        short = np.maximum(lane.CONVERGED**2, lane.CONVERGED_SIGMAS**2 * inverse[:, 0, 0])
        active[(step[:, 0] ** 2 < short) & (np.abs(step[:, 2]) < lane.CONVERGED_WIDTH)] = 0.0
        if not active[good].any():
            break
    variance = row[:, 0]
    if len(rho) and noise[2] > 0:
        mean, stripe, jacobian = _model(at, x)
        weight = usable / (noise[0] + np.maximum(noise[1] * mean, 0.0) + noise[2] * stripe**2 + extra)
        share = np.einsum("lxp,lp->lx", jacobian, row)
        variance = row[:, 2] ** 2 * prior + np.sum(weight * share**2, axis=1)
        moved = weight * share * stripe
        for lag, correlated in enumerate(rho[: lane.LAGS], start=1):
            variance = variance + 2 * noise[2] * correlated * np.sum(moved[:, lag:] * moved[:, :-lag], axis=1)
    done = lines[good]
    out[fit.FIT_CENTRE, done] = (origin + at[:, 0])[good]
    out[fit.SIGMA, done] = np.sqrt(variance[good])
    out[fit.AMPLITUDE, done] = at[good, 1]
    out[fit.WIDTH, done] = np.exp(at[good, 2])
    out[fit.LEVEL, done] = at[good, 3]
    out[fit.SLOPE, done] = at[good, 4] / lane.UNIT
    out[fit.CHI2, done] = chi2[good] / (usable.sum(axis=1)[good] - fit.PARAMETERS)
    out[fit.FISHER, done] = np.sqrt(row[good, 0])


def _model(at: Any, x: Any) -> tuple[Any, Any, Any]:
    """Mean and stripe (lines, px) of the parameters `at` (lines, 5), and the derivatives (lines, px, 5)."""
    inverse = np.exp(-at[:, 2:3])
    z = (x - at[:, :1]) * inverse
    g = np.exp(-0.5 * z * z)
    stripe = at[:, 1:2] * g
    slope = np.broadcast_to(x / lane.UNIT, z.shape)
    mean = stripe + at[:, 3:4] + at[:, 4:] * slope
    return mean, stripe, np.stack([stripe * z * inverse, g, stripe * z * z, np.ones_like(z), slope], axis=2)
