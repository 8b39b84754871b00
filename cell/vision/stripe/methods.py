"""The classical centres: extreme value, centre of gravity, Gaussian through three points or many, Steger.

Each takes the peaks that the search found and gives a centre and its standard deviation by propagation of the pixels'
noise, speckle as declared or as assumed. They are there to compare with; maximum likelihood is better in all of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.vision.stripe import find as find
from cell.vision.stripe import fit as fit
from cell.vision.stripe.lanes import HALF

if TYPE_CHECKING:
    from cell.vision.stripe.extract import StripeSettings

Array = NDArray[np.float64]

REACH = 3.0
"""Half the window in stripe widths."""
FLATNESS = 0.12
"""How much of the squared width of the peak's flat part adds to the extreme value's variance; from simulation."""
LEAST_SHARE = 0.15
"""Least height over the peak's of a pixel whose logarithm is used."""
STEGER_SCALE = 1.5


@dataclass(frozen=True)
class Windows:
    """The pixels around each peak: `x` (px,) from `origin` (lines,); `value` above the background and `variance`
    (lines, px) in DN, `usable` those in the picture and not saturated; `height` and `width` of the peak; the speckle's
    `contrast` and its correlations `rho` at lags 1, 2, …"""

    x: Array
    origin: NDArray[np.intp]
    value: Array
    variance: Array
    usable: NDArray[np.bool_]
    height: Array
    width: Array
    contrast: float
    rho: Array

    def sigma(self, influence: Array) -> Array:
        """Standard deviation (lines,) of a centre that moves by `influence` (lines, px) px per DN of each pixel."""
        total = np.sum(influence**2 * self.variance, axis=1)
        moved = influence * np.maximum(self.value, 0.0)
        for lag, correlated in enumerate(self.rho, start=1):
            if lag < moved.shape[1]:
                total += 2 * self.contrast**2 * correlated * np.sum(moved[:, lag:] * moved[:, :-lag], axis=1)
        return np.asarray(np.sqrt(np.maximum(total, 0.0)))


Centres = tuple[Array, Array]


def _windows(
    image: Any,
    dark: Any,
    start: Array,
    lines: NDArray[np.intp],
    noise: tuple[float, float, int],
    speckle: tuple[float, Any],
    settings: StripeSettings,
) -> Windows:
    """Windows of the lines' chosen peaks; the background is the mean of their ends."""
    best = start[lines, 0]
    width = np.clip(_smooth(best[:, find.WIDTH]), *settings.width_range_px)
    origin = np.floor(best[:, find.CENTRE] + 0.5).astype(np.intp)
    reach = np.ceil(REACH * width + 0.5 * best[:, find.CORE]).astype(int)
    half = int(np.clip(reach.max(initial=2), 2, HALF))
    x = np.arange(-half, half + 1)
    column = origin[:, None] + x
    usable = (column >= 0) & (column < image.shape[1]) & (np.abs(x) <= reach[:, None])
    column = np.clip(column, 0, image.shape[1] - 1)
    raw = image[lines[:, None], column].astype(np.float64)
    usable &= raw < settings.saturation_dn
    read, gain, frames = noise
    variance = read + gain * raw
    value = raw
    if frames:
        shade = dark[lines[:, None], column].astype(np.float64)
        value = raw - shade
        variance = variance + (read + gain * shade) / frames
    value = value - best[:, find.BACKGROUND, None]
    contrast, rho = speckle
    variance = variance + (contrast * np.maximum(value, 0.0)) ** 2
    return Windows(x.astype(np.float64), origin, value, variance, usable, best[:, find.HEIGHT], width, contrast, rho)


def _smooth(values: Array) -> Array:
    """Median over 9 neighbours, so that a window does not change from line to line."""
    if len(values) < 9:
        return np.full(len(values), np.median(values)) if len(values) else values
    padded = np.pad(values, 4, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, 9), axis=1))


def _extreme_value(w: Windows) -> Centres:
    """The brightest pixel. σ: half a pixel's uniform error, and the pixels that noise lets pass for the brightest."""
    value = np.where(np.abs(w.x) <= REACH * w.width[:, None], w.value, -np.inf)
    place = value.argmax(axis=1)
    row = np.arange(len(place))
    # Mean and spread of the flat part of the peak: twice the variance is that of a difference of two pixels.
    behind = (value[row, place][:, None] - value) ** 2 / (4 * w.variance[row, place][:, None])
    chance = np.exp(-np.minimum(behind, 700.0))
    chance /= chance.sum(axis=1, keepdims=True)
    away = (w.x - w.x[place][:, None]) ** 2
    spread = FLATNESS * np.sum(chance * away, axis=1)
    return w.x[place], np.sqrt(1 / 12 + spread)


def _centre_of_gravity(w: Windows) -> Centres:
    """First moment over ±`REACH` widths; saturated pixels count as they are read, with the error that this makes."""
    inside = np.abs(w.x) <= np.ceil(REACH * w.width)[:, None]
    value = np.where(inside, w.value, 0.0)
    energy = np.maximum(value.sum(axis=1), 1e-9)
    centre = value @ w.x / energy
    influence = np.where(inside, w.x - centre[:, None], 0.0) / energy[:, None]
    # The background is the mean of eight pixels, and shared by the whole window.
    shared = influence.sum(axis=1) ** 2 * w.variance.min(axis=1) / 8
    return centre, np.sqrt(w.sigma(influence) ** 2 + shared)


def _gaussian_3_point(w: Windows) -> Centres:
    """Parabola through the logarithms of the brightest pixel and its neighbours."""
    value = np.where(np.abs(w.x) <= REACH * w.width[:, None], w.value, -np.inf)
    place = np.clip(value.argmax(axis=1), 1, len(w.x) - 2)
    row = np.arange(len(place))
    three = np.stack([w.value[row, place + k] for k in (-1, 0, 1)], axis=1)
    usable = (three > 0).all(axis=1)
    logs = np.log(np.maximum(three, 1e-9))
    bend = 2 * logs[:, 1] - logs[:, 0] - logs[:, 2]
    # A saturated peak is flat: there is no parabola through it.
    usable &= bend > 1e-9
    bend = np.where(usable, bend, 1.0)
    shift = 0.5 * (logs[:, 2] - logs[:, 0]) / bend
    slopes = np.stack([(shift - 0.5) / bend, -2 * shift / bend, (shift + 0.5) / bend], axis=1)
    influence = np.zeros_like(w.value)
    influence[row[:, None], place[:, None] + np.arange(-1, 2)] = slopes / np.maximum(three, 1e-9)
    return np.where(usable, w.x[place] + shift, np.nan), w.sigma(influence)


def _gaussian_least_squares(w: Windows) -> Centres:
    """Parabola through the logarithms of all pixels above `LEAST_SHARE` of the peak, weighted by their precision."""
    share = w.value / np.maximum(w.height, 1e-9)[:, None]
    near = np.abs(w.x) <= 2.0 * w.width[:, None] + 0.5 * np.sum(~w.usable, axis=1)[:, None]
    # Which pixels count must not depend on their noise near the limit: the expected share decides as well.
    used = w.usable & near & (share > LEAST_SHARE)
    value = np.where(used, w.value, 1.0)
    weight = np.where(used, value**2 / w.variance, 0.0)
    scale = 1 / np.maximum(w.width, 0.5)
    basis = np.stack([np.ones_like(value), w.x * scale[:, None], (w.x * scale[:, None]) ** 2], axis=2)
    weighted = basis * weight[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ basis
    solvable = used.sum(axis=1) >= 4
    normal[~solvable] = np.eye(3)
    inverse = np.linalg.inv(normal + 1e-12 * np.eye(3))
    found = np.einsum("lpq,lxq,lx->lp", inverse, weighted, np.log(value))
    solvable &= found[:, 2] < -1e-6
    bend = np.where(solvable, found[:, 2], -1.0)
    centre = -0.5 * found[:, 1] / bend
    slope = np.stack([np.zeros(len(bend)), -0.5 / bend, 0.5 * found[:, 1] / bend**2], axis=1)
    influence = np.einsum("lp,lpq,lxq->lx", slope, inverse, weighted) / value / scale[:, None]
    return np.where(solvable, centre / scale, np.nan), w.sigma(influence)


def _steger(image: Any, dark: Any, start: Array, lines: NDArray[np.intp], w: Windows, frames: int) -> Centres:
    """Where the first derivative across the ridge is 0 along the line, by Gaussian derivatives of the whole picture.

    The direction across is the eigenvector of the Hessian with the most negative eigenvalue (Steger 1998).
    """
    scale = float(max(STEGER_SCALE, np.median(w.width) if len(lines) else 0.0))
    gx, gy, gxx, gxy, gyy = gaussian_derivatives(image.astype(np.float32) - (dark if frames else 0.0), scale)
    half = int(np.ceil(w.width.max(initial=1.0)))
    near = np.arange(-half, half + 1)
    column = np.clip(w.origin[:, None] + near, 0, image.shape[1] - 1)
    place = gxx[lines[:, None], column].argmin(axis=1)
    at = lines, np.take_along_axis(column, place[:, None], axis=1)[:, 0]
    a, b, c = (part[at].astype(np.float64) for part in (gxx, gxy, gyy))
    across = 0.5 * np.arctan2(2 * b, a - c)
    nx, ny = np.cos(across), np.sin(across)
    # Of the two eigenvectors the one along which the picture bends down more.
    other = a * ny**2 - 2 * b * nx * ny + c * nx**2 < a * nx**2 + 2 * b * nx * ny + c * ny**2
    nx, ny = np.where(other, -ny, nx), np.where(other, nx, ny)
    slope = nx * gx[at] + ny * gy[at]
    bend = nx * a + ny * b
    usable = (bend * nx < 0) & (np.abs(slope) < np.abs(bend) * half)
    bend = np.where(usable, bend, 1.0)
    shift = -slope / bend
    # The derivative filter's response to the pixels' noise; rows are averaged as well: 1/(2 √π s) of the variance.
    g = np.exp(-0.5 * (w.x / scale) ** 2) / (np.sqrt(2 * np.pi) * scale)
    one_row = w.sigma(np.broadcast_to(w.x / scale**2 * g, w.value.shape))
    rows = (1 + 2 * w.rho.sum()) / (2 * np.sqrt(np.pi) * scale)
    sigma = one_row * np.sqrt(min(1.0, rows)) * np.abs(nx / bend)
    return np.where(usable, at[1] - w.origin + shift, np.nan), sigma


def gaussian_derivatives(image: Any, scale: float) -> list[Any]:
    """∂x, ∂y, ∂xx, ∂xy, ∂yy (h, w) of a picture at a scale in px, by separable filters."""
    half = int(np.ceil(4 * scale))
    x = np.arange(-half, half + 1, dtype=np.float64)
    plain = np.exp(-0.5 * (x / scale) ** 2)
    plain /= plain.sum()
    once = plain * x / scale**2
    twice = plain * (x**2 / scale**4 - 1 / scale**2)
    twice -= twice.mean()
    pairs = ((once, plain), (plain, once), (twice, plain), (once, once), (plain, twice))
    return [cv2.sepFilter2D(image, cv2.CV_32F, kx, ky, borderType=cv2.BORDER_REPLICATE) for kx, ky in pairs]


def _method(centres: Callable[[Windows], Centres] | None) -> Callable[..., Array]:
    def run(
        image: Any,
        dark: Any,
        start: Array,
        lines: NDArray[np.intp],
        noise: tuple[float, float, int],
        speckle: tuple[float, Any],
        settings: StripeSettings,
    ) -> Array:
        """`fitted` (FITTED, image lines) as from `fit_lines`; `noise` is variance, gain and the frames of the dark,
        `speckle` contrast and correlations."""
        w = _windows(image, dark, start, lines, noise, speckle, settings)
        centre, sigma = centres(w) if centres is not None else _steger(image, dark, start, lines, w, noise[2])
        fitted = np.full((fit.FITTED, len(image)), np.nan)
        fitted[fit.FIT_CENTRE, lines] = w.origin + centre
        fitted[fit.SIGMA, lines] = fitted[fit.FISHER, lines] = sigma
        fitted[fit.AMPLITUDE, lines], fitted[fit.WIDTH, lines] = w.height, w.width
        fitted[fit.LEVEL, lines], fitted[fit.SLOPE, lines], fitted[fit.CHI2, lines] = 0.0, 0.0, 1.0
        return fitted

    return run


METHODS: dict[str, Callable[..., Array]] = {
    "extreme_value": _method(_extreme_value),
    "centre_of_gravity": _method(_centre_of_gravity),
    "gaussian_3_point": _method(_gaussian_3_point),
    "gaussian_least_squares": _method(_gaussian_least_squares),
    "steger": _method(None),
}
