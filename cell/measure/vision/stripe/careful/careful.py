"""The stripe of pictures that are not ordinary: colour, deep, wide, textured, with scenery, of an unknown profile.

Slower than the search and fit of ordinary pictures: the plane is chosen in which the laser stands out, the stripe is
followed as a line, its profile learned, and the deviation told from what surrounds it. `extract` comes here by itself.

A picture teaches one width, and what differs from it by more than twice is not believed: pieces that are out of focus,
or on what shines. Rows that stay without a stripe so are read once more by themselves, and what they show is taken
where it goes on from the rest of the line.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.careful import follow
from cell.measure.vision.stripe.careful.follow import Candidates, StripeChain
from cell.measure.vision.stripe.careful.learning import FREE_SCALE, learn_profile
from cell.measure.vision.stripe.careful.shaped_fit import Fitted, Noise, Plane, Shape, binned, fit_shape
from cell.measure.vision.stripe.careful.surroundings import around, carried, surrounded, wander
from cell.measure.vision.stripe.ordinary.quick import MISFIT_SIGMAS
from cell.measure.vision.stripe.planes import MIXES, LaserChannel, Picture
from cell.measure.vision.stripe.profile import StripeProfile, StripeSettings

Array = NDArray[np.float64]

LEAST_ROWS = 32
END_ROWS = 12
"""So many rows on either side of a seam tell whether the line goes on there."""
SEAM_ROWS = 3 * END_ROWS
LEAST_LINE, LEAST_SHARE = 0.3, 0.8
"""Shares of the picture's rows, and of a piece's, that have to show the line."""
MOST_LIGHT = 4.0
"""Times more or less light than the rest of the line: a laser has the same everywhere, a surface takes its share."""


def fill_gaps(line: StripeProfile, read: Callable[[slice], StripeProfile]) -> None:
    """Fill into `line` what `read` finds in its longer gaps, where that is the same line in another width."""
    seen = np.isfinite(line.centres)
    if seen.mean() < LEAST_LINE:
        return
    for gap in _gaps(seen):
        piece = read(gap)
        there = np.isfinite(piece.centres)
        if there.sum() < LEAST_ROWS or there.mean() < LEAST_SHARE or not _goes_on(line, gap, piece):
            continue
        for name in ("centres", "sigma", "amplitude", "width", "saturated", "rival", "misfit"):
            getattr(line, name)[gap] = getattr(piece, name)


def _gaps(seen: NDArray[np.bool_]) -> list[slice]:
    """Runs of rows that show little of the line, which lies right beside them."""
    share = np.convolve(
        np.pad(seen.astype(np.float64), END_ROWS // 2, "edge"), np.full(END_ROWS + 1, 1 / (END_ROWS + 1))
    )
    sparse = share[END_ROWS : END_ROWS + len(seen)] < LEAST_SHARE
    edges = np.flatnonzero(np.diff(np.r_[False, sparse, False]))
    beside = [
        (a, b, seen[max(0, a - SEAM_ROWS) : a].sum(), seen[b : b + SEAM_ROWS].sum()) for a, b in edges.reshape(-1, 2)
    ]
    return [slice(int(a), int(b)) for a, b, *ends in beside if b - a >= LEAST_ROWS and max(ends) >= END_ROWS]


def _goes_on(line: StripeProfile, gap: slice, piece: StripeProfile) -> bool:
    """Whether the piece meets the line at one of its ends, at least."""
    rows = np.flatnonzero(np.isfinite(line.centres))
    own = gap.start + np.flatnonzero(np.isfinite(piece.centres))
    before, after = rows[rows < gap.start][-END_ROWS:], rows[rows >= gap.stop][:END_ROWS]
    return any(
        _meet(_end(line, beside, 0), _end(piece, inner, gap.start))
        for beside, inner in ((before, own[:END_ROWS]), (after, own[-END_ROWS:]))
        if min(len(beside), len(inner)) == END_ROWS
    )


@dataclass(frozen=True)
class _End:
    """An end of a line: its middle `row`, `place` in px and `slope` there, its width in px and light in DN px."""

    row: float
    place: float
    slope: float
    width: float
    light: float


def _end(line: StripeProfile, rows: NDArray[np.intp], first: int) -> _End:
    """Of `rows` of the picture, of which `first` is the line's first."""
    at = rows - first
    slope, place = np.polyfit(rows - rows.mean(), line.centres[at], 1)
    width, light = (float(np.median(values[at])) for values in (line.width, line.amplitude * line.width))
    return _End(float(rows.mean()), float(place), float(slope), width, light)


def _meet(one: _End, other: _End) -> bool:
    """Whether they lie on one straight line and have about as much light."""
    if abs(other.row - one.row) > SEAM_ROWS or not 1 / MOST_LIGHT < one.light / other.light < MOST_LIGHT:
        return False
    half = 0.5 * (other.row - one.row)
    apart = one.place + one.slope * half - (other.place - other.slope * half)
    return abs(apart) < max(1.0, 0.5 * max(one.width, other.width))


MOST_WANDER = 8.0
WIDEST = 48.0
"""σ in px of the Gaussian that fits the widest stripe best, 45 of a flat top of 30 px; what is wider is light and shade
on the scenery."""


@dataclass(frozen=True)
class Learned:
    """What a picture taught that holds for others of the same set-up: the `mix` of colours, the `scale` that answers
    (σ in px), the profile's `shape` in pixels of `binned` px, its `spread` from line to line, the `noise`, and by how
    many px rows were blurred `along` the line to find it."""

    mix: str
    scale: float
    binned: int
    shape: Shape
    spread: float
    noise: Noise
    along: float


def read_carefully(
    picture: Picture, off: Picture | None, laser: LaserChannel, settings: StripeSettings, like: Learned | None = None,
    starts: Array | None = None,
) -> StripeProfile:  # fmt: skip
    """The stripe of `picture`, whose rows it crosses; `off` is the same view without the laser. Marks no line `double`.

    `starts` (lines,) in px, NaN where there is none, spare the following. Pieces of another width are read where the
    picture itself teaches the profile.
    """
    line = _of_one_width(picture, off, laser, settings=settings, like=like, starts=starts)
    if like is None:
        fill_gaps(
            line,
            lambda rows: _of_one_width(picture.rows(rows), off and off.rows(rows), laser, settings, None, starts=None),
        )
    return line


def _of_one_width(
    picture: Picture, off: Picture | None, laser: LaserChannel, settings: StripeSettings, like: Learned | None,
    starts: Array | None,
) -> StripeProfile:  # fmt: skip
    """`read_carefully` without what differs in width from the rest by more than twice."""
    lines = picture.value.shape[0]
    mix = like.mix if like is not None else follow.choose_mix(picture, off, laser)
    value, usable, shade = follow.difference(picture, off, mix)
    rival = np.zeros(lines)
    if starts is None:
        found, chain, scale, along = _follow(value, like)
        if not len(chain.rows):
            return _nothing(lines)
        place = np.full(lines, np.nan)
        place[chain.rows] = found.place[chain.rows, chain.which]
        rival = _rivals(found, chain)
        place = _bridge(place)
    else:
        place, scale, along = starts, like.scale if like is not None else follow.SCALES[2], follow.ALONG
    rows = np.flatnonzero(np.isfinite(place))
    k = like.binned if like is not None else max(1, int(scale / follow.BINNED_WIDTH))
    plane = binned(Plane(value, usable, shade, _albedo(shade, usable)), k)
    at = (place[rows] - 0.5 * (k - 1)) / k
    noise = Noise(settings.read_noise_dn**2 / k, settings.gain_dn / k * float(np.abs(MIXES[mix]).sum()))
    if like is None:
        noise = surrounded(plane, rows, at, 4 * scale / k, noise)
        shape, spread, noise = learn_profile(plane, rows, at, scale / k, noise)
        if shape.width * k > WIDEST:
            return _nothing(lines)
        learned = Learned(mix, shape.width * k, k, shape=shape, spread=spread, noise=noise, along=along)
    else:
        learned = like
    shape, noise = learned.shape, learned.noise
    fitted = fit_shape(
        plane, rows, at, shape, noise=noise, scale_prior=max(learned.spread, 0.002) if shape.learned else FREE_SCALE
    )
    variance, correlation, _ = around(plane, rows, np.where(fitted.good, fitted.centre, at), shape.reach)
    sigma = carried(fitted, variance, correlation)
    out = _believed(fitted, sigma, at, shape=shape, k=k, lines=lines, plane=plane, noise=noise)
    # A surface may be rough: lines that wander tell of errors only where something is there to make them.
    unquiet = noise.contrast > 0.02 or (correlation[1:] != 0).any()
    factor = min(wander(out.centres, out.sigma), MOST_WANDER) if unquiet else 1.0
    return replace(out, sigma=out.sigma * factor, rival=rival, learned=learned)


def _follow(value: NDArray[np.float32], like: Learned | None) -> tuple[Candidates, StripeChain, float, float]:
    """Candidates and chain in all rows, the scale in px that answers most, and by how many px rows were blurred."""
    scales = np.asarray(follow.SCALES)
    typical, along = (like.scale, like.along) if like is not None else (0.0, follow.ALONG)
    if not typical:
        found, chain, along = follow.coarse(value)
        if not len(chain.rows) or chain.score < follow.FAINTEST:
            return found, StripeChain(chain.rows[:0], chain.which[:0], chain.piece[:0], 0.0), 0.0, along
        # What a shrunken picture answers at may be wider than any stripe that is looked for.
        typical = float(np.median(found.scale[chain.rows, chain.which]))
    # One that was taught may be narrower than any, such as a column of the sensor that is always bright.
    typical = min(max(typical, follow.SCALES[0]), follow.SCALES[-1])
    near = scales[np.abs(np.log(scales / typical)) < 0.75]
    found = follow.candidates(value, np.arange(len(value)), tuple(near), along)
    chain = follow.follow(found)
    if not len(chain.rows):
        return found, chain, typical, along
    return found, chain, float(np.median(found.scale[chain.rows, chain.which])), along


def _bridge(place: Array) -> Array:
    """Places also in the gaps of the chain that are short and go on at the other side."""
    there = np.flatnonzero(np.isfinite(place))
    if len(there) < 2:
        return place
    before, after = there[:-1], there[1:]
    size = after - before
    smooth = (size > 1) & (size <= 24) & (np.abs(place[after] - place[before]) < 1.0 * size + 2)
    filled = place.copy()
    for first, last in zip(before[smooth], after[smooth], strict=True):
        filled[first : last + 1] = np.interp(np.arange(first, last + 1), (first, last), (place[first], place[last]))
    return filled


def _rivals(found: Candidates, chain: StripeChain) -> Array:
    """Response of the best candidate beside the chain over the chain's, of each row (m,), 0 where none is clear."""
    rival = np.zeros(len(found.rows))
    own = found.response[chain.rows, chain.which]
    away = np.abs(found.place[chain.rows] - found.place[chain.rows, chain.which][:, None])
    beside = (away > 3 * found.scale[chain.rows, chain.which][:, None]) & (found.clear[chain.rows] > 6)
    beside &= np.arange(follow.CANDIDATES) != chain.which[:, None]
    rival[chain.rows] = np.where(beside, found.response[chain.rows], 0.0).max(axis=1) / np.maximum(own, 1e-6)
    return np.maximum(rival, _second_line(found, chain))


def _second_line(found: Candidates, chain: StripeChain) -> Array:
    """Response of a second line that runs beside the chain over the chain's (m,): its mean in rows where it hides."""
    other = follow.follow(follow.without_line(found, chain))
    rival = np.zeros(len(found.rows))
    height = float(np.median(found.response[chain.rows, chain.which]))
    for one in np.unique(other.piece):
        rows, which = other.rows[other.piece == one], other.which[other.piece == one]
        inside = slice(int(rows[0]), int(rows[-1]) + 1)
        rival[inside] = np.maximum(rival[inside], float(np.median(found.response[rows, which])) / max(height, 1e-6))
    return rival


BRIGHT, SMOOTH_PX = 25.0, 31
"""DN of a picture without the laser from which it tells the albedo, and the px over which that is taken to be 1."""


def _albedo(shade: NDArray[np.float32] | None, usable: NDArray[np.bool_]) -> NDArray[np.float32] | None:
    """How much lighter each pixel is than its surroundings in the picture without the laser; None where it is dark."""
    if shade is None or float(np.median(shade)) < BRIGHT:
        return None
    here: Array = np.asarray(cv2.GaussianBlur(shade, (3, 3), 0), dtype=np.float64)
    surroundings: Array = np.asarray(cv2.blur(here, (SMOOTH_PX, SMOOTH_PX)), dtype=np.float64)
    relative = np.where(usable & (surroundings > BRIGHT), here / np.maximum(surroundings, 1.0), 1.0)
    return np.asarray(np.clip(relative, 0.1, 4.0), dtype=np.float32)


def _believed(
    fitted: Fitted, sigma: Array, at: Array, shape: Shape, k: int, lines: int, plane: Plane, noise: Noise,
) -> StripeProfile:  # fmt: skip
    """The fits that are a stripe, in px of the picture and lines of all of it."""
    width = shape.width
    # Speckle makes a stripe's height uncertain, not that there is one.
    clear = np.minimum(fitted.amplitude_sigma, np.sqrt(noise.floor))
    keep = fitted.good & (fitted.amplitude > follow.SURE * clear)
    keep &= np.abs(fitted.centre - at) < np.maximum(2.0, 1.5 * width)
    keep &= sigma < np.maximum(1.0, 0.7 * width)
    if keep.any():
        usual = float(np.median(fitted.log_scale[keep]))
        keep &= np.abs(fitted.log_scale - usual) < 0.8
    keep &= (fitted.centre > 1.0) & (fitted.centre < plane.value.shape[1] - 2.0)
    out = _nothing(lines)
    assert out.misfit is not None
    rows = fitted.lines[keep]
    out.centres[rows] = k * fitted.centre[keep] + 0.5 * (k - 1)
    out.amplitude[rows] = fitted.amplitude[keep]
    out.width[rows] = k * width * np.exp(fitted.log_scale[keep])
    usual = float(np.median(fitted.chi2[keep])) if keep.any() else 1.0
    misfit = fitted.chi2[keep] / max(usual, 1e-6)
    allowed = 1 + MISFIT_SIGMAS * np.sqrt(2 / (8 * width + 2))
    out.sigma[rows], out.misfit[rows] = k * sigma[keep] * np.sqrt(np.maximum(1.0, misfit / allowed)), misfit
    inside = (np.abs(fitted.x) < width) & np.isinf(fitted.variance)
    out.saturated[rows] = inside[keep].any(axis=1)
    return out


def _nothing(lines: int) -> StripeProfile:
    centres, sigma, amplitude, width, misfit = np.full((5, lines), np.nan)
    no, rival = np.zeros((2, lines), np.bool_), np.zeros(lines)
    return StripeProfile(
        "rows", centres, sigma, amplitude, width=width, saturated=no[0], double=no[1], rival=rival, misfit=misfit
    )
