"""The stripe followed as a line: of all that looks like a stripe in each row, the chain that runs through the picture.

A row's response is how far a spot stands above *both* its sides, so that an edge of the scene answers little.
Candidates of neighbouring rows are chained by dynamic programming: a chain may bend and have gaps; a jump, such as a
step of the surface makes, costs as much as several clear rows are worth. A coarse look in some rows says in which mix
of colours the line stands out.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.vision.stripe.careful.learning import FREE_SCALE
from cell.measure.vision.stripe.careful.shaped_fit import Noise, Plane, binned, fit_shape, gaussian
from cell.measure.vision.stripe.careful.surroundings import around, carried, surrounded
from cell.measure.vision.stripe.planes import MIXES, LaserChannel, Picture

Array = NDArray[np.float64]
Places = NDArray[np.intp]

SCALES = (0.8, 1.4, 2.4, 4.0, 7.0, 12.0, 20.0, 30.0)
"""Stripe widths σ in px that are looked for."""
CANDIDATES = 6
SIDES = 2.8
"""Where the sides of a stripe are, in widths."""
LEAST = 2.5
"""Response over noise from which a candidate speaks for the chain, and how much one says at most."""
MOST = 25.0
# What a chain pays: for a px aside and row, for a row of a gap, for a jump.
ASIDE, GAP, JUMP = 0.5, 0.4, 30.0
LONGEST_GAP = 24
STEEPEST = 2.5
"""A chain moves no more than this many px a row, and one width more."""
BY_LIGHT = 0.08
AGAINST = 0.5
"""How much the strongest thing beside the chain in each row counts against it."""
LEAST_SCORE, LEAST_ROWS = 60.0, 8
"""Of a piece of the chain that is believed."""
UNLIKE, FAINTER, OUTDONE = 1.4, 0.25, 0.5
"""A piece belongs to the line if it is about as wide, in the logarithm, at least this share as clear as the best, and
if in no more than this share of its rows something beside it is clearer."""


@dataclass(frozen=True)
class Candidates:
    """What looks like a stripe in `rows` (m,) of the picture, CANDIDATES each (m, CANDIDATES): `place` in px,
    `response` in DN, `clear`, that over its noise (0: none), and the `scale` in px that answers most."""

    rows: NDArray[np.intp]
    place: Array
    response: Array
    clear: Array
    scale: Array


@dataclass(frozen=True)
class StripeChain:
    """The line that was followed: `rows` (k,), indices of those of the candidates, `which` of them, and the `piece`
    each belongs to. `score` is what it says for itself, a row on average, less what in the picture says otherwise."""

    rows: NDArray[np.intp]
    which: NDArray[np.intp]
    piece: NDArray[np.intp]
    score: float


def respond(picture: NDArray[np.float32], scale: float, along: float) -> NDArray[np.float32]:
    """How far, in DN, each place of `picture` (m, n) stands above both its sides, for a stripe of σ `scale` px. Rows
    are blurred by `along` px."""
    across = cv2.getGaussianKernel(2 * int(np.ceil(2 * max(0.5, 0.6 * scale))) + 1, max(0.5, 0.6 * scale))
    rows = cv2.getGaussianKernel(2 * int(2.5 * along) + 1, along or 1.0)
    smooth = cv2.sepFilter2D(picture, cv2.CV_32F, across, rows, borderType=cv2.BORDER_REPLICATE)
    away = max(2, round(SIDES * scale))
    padded = cv2.copyMakeBorder(smooth, 0, 0, away, away, borderType=cv2.BORDER_REPLICATE)
    n = picture.shape[1]
    return np.asarray(smooth - np.maximum(padded[:, :n], padded[:, 2 * away :]), dtype=np.float32)


def candidates(
    part: NDArray[np.float32], rows: NDArray[np.intp], scales: tuple[float, ...], along: float
) -> Candidates:
    """What looks like a stripe of one of `scales` in the rows of `part` (m, n), in DN, which are `rows` of the picture.
    Neighbouring rows are blurred by `along` px."""
    n = part.shape[1]
    best = np.full(part.shape, -np.inf, np.float32)
    answer = np.zeros(part.shape, np.float32)
    of = np.zeros(part.shape, np.uint8)
    for k, scale in enumerate(scales):
        if 6 * scale > n:
            continue
        response = respond(part, scale, along)
        # Noise: how what answers where nothing is, the middle of all answers, scatters.
        few = response[:: max(1, len(response) // 128), :: max(1, response.shape[1] // 512)]
        low, middle = np.percentile(few, (30, 50))
        _take_better(response, np.float32(max(float(middle - low) / 0.5244, 0.05)), k, best=best, answer=answer, of=of)
    edge = 2
    peak = np.zeros(part.shape, np.bool_)
    peak[:, edge:-edge] = (best[:, edge:-edge] >= best[:, edge - 1 : -edge - 1]) & (
        best[:, edge:-edge] > best[:, edge + 1 : n - edge + 1]
    )
    score = np.where(peak & (best > LEAST), best, 0.0)
    place = np.argpartition(-score, CANDIDATES, axis=1)[:, :CANDIDATES]
    line = np.arange(len(rows))[:, None]
    return Candidates(
        rows, place.astype(np.float64), answer[line, place].astype(np.float64), score[line, place].astype(np.float64),
        np.asarray(scales)[of[line, place]],
    )  # fmt: skip


@compiled
def _take_better(
    response: NDArray[np.float32], noise: np.float32, k: int, best: NDArray[np.float32],
    answer: NDArray[np.float32], of: NDArray[np.uint8],
) -> None:  # fmt: skip  # pragma: no cover
    for row in range(response.shape[0]):
        for column in range(response.shape[1]):
            clear = response[row, column] / noise
            if clear > best[row, column]:
                best[row, column], answer[row, column], of[row, column] = clear, response[row, column], k


def follow(found: Candidates, spacing: float = 1.0) -> StripeChain:
    """The chain through `found` whose rows are `spacing` px apart on average."""
    m = len(found.rows)
    # Of two lines that are clear alike the one with more light; not so much that a dark spot makes the chain jump.
    light = found.response * found.scale
    share = light / np.maximum(light.max(axis=1, keepdims=True), 1e-9)
    gain = np.minimum(found.clear, MOST) * (1 - BY_LIGHT * (1 - share)) - LEAST * (found.clear > 0)
    best, back_row, back_which, opens = _chain(
        found.rows.astype(np.float64), found.place, gain, found.clear > 0, scale=found.scale, spacing=float(spacing)
    )
    rows, which, fresh = [], [], []
    r, k = divmod(int(best.argmax()), CANDIDATES)
    while r >= 0 and best[r, k] > 0:
        rows.append(r)
        which.append(k)
        fresh.append(bool(opens[r, k]))
        r, k = int(back_row[r, k]), int(back_which[r, k])
    order = np.array(rows[::-1], dtype=np.intp)
    chosen = np.array(which[::-1], dtype=np.intp)
    piece = np.cumsum(np.array(fresh[::-1], dtype=np.intp)) if m and len(order) else order
    return _believed(found, order, chosen, piece)


def _believed(found: Candidates, rows: Places, which: Places, piece: Places) -> StripeChain:
    """Without the pieces that noise may have made."""
    if not len(rows):
        return StripeChain(rows, which, piece, 0.0)
    said = np.minimum(found.clear[rows, which], MOST) - LEAST
    keep = np.zeros(len(rows), np.bool_)
    scale = found.scale[rows, which]
    others = found.clear.copy()
    others[rows, which] = 0.0
    outdone = others[rows].max(axis=1) > np.maximum(found.clear[rows, which], 2 * LEAST)
    pieces = [piece == one for one in np.unique(piece)]
    main = max(pieces, key=lambda here: float(said[here].sum()))
    for here in pieces:
        alike = abs(np.log(np.median(scale[here]) / np.median(scale[main]))) < UNLIKE
        alike = alike and outdone[here].mean() < OUTDONE and said[here].mean() > FAINTER * said[main].mean()
        if alike and said[here].sum() > LEAST_SCORE and here.sum() >= LEAST_ROWS:
            keep |= here
    rows, which, piece, said = rows[keep], which[keep], piece[keep], said[keep]
    rivals = np.clip(others.max(axis=1) - 2 * LEAST, 0.0, MOST).sum()
    score = float(said.sum() - JUMP * len(np.unique(piece)) - AGAINST * rivals)
    return StripeChain(rows, which, piece, score / len(found.rows))


@compiled
def _chain(
    rows: Places, place: Array, gain: Array, there: NDArray[np.bool_], scale: Array, spacing: float
) -> tuple[Array, Places, Places, NDArray[np.bool_]]:
    """Best sums that end at each candidate (m, CANDIDATES), where they come from, and whether by a jump."""
    m, count = place.shape
    best = np.zeros((m, count))
    back_row, back_which = np.full((m, count), -1), np.zeros((m, count), np.int64)
    opens = np.ones((m, count), np.bool_)
    top, top_row, top_which = 0.0, -1, 0
    for r in range(m):
        for k in range(count):
            if not there[r, k]:
                continue
            value, from_row, from_which, fresh = top - JUMP, top_row, top_which, True
            if value < 0.0:
                value, from_row = 0.0, -1
            for before in range(r - 1, max(-1, r - 1 - LONGEST_GAP), -1):
                apart = rows[r] - rows[before]
                if apart > LONGEST_GAP * spacing:
                    break
                limit = STEEPEST * apart + 1.0 + scale[r, k]
                for j in range(count):
                    aside = abs(place[r, k] - place[before, j])
                    if not there[before, j] or aside > limit:
                        continue
                    sum_ = best[before, j] - ASIDE * max(0.0, aside - 0.5) / spacing - GAP * (apart / spacing - 1.0)
                    if sum_ > value:
                        value, from_row, from_which, fresh = sum_, before, j, False
            best[r, k] = value + gain[r, k]
            back_row[r, k], back_which[r, k], opens[r, k] = from_row, from_which, fresh
        for k in range(count):
            if best[r, k] > top:
                top, top_row, top_which = best[r, k], r, k
    return best, back_row, back_which, opens


COARSE_ROWS, COARSE_COLUMNS = 160, 1400
ALONG, FAR_ALONG, WEAK_SCORE = 0.8, 3.0, 8.0
"""Rows are blurred by the first before the line is looked for in them, in px; by the second where it scores less."""
BINNED_WIDTH = 4.0
"""A stripe wider than twice this, σ in px, is looked at through pixels so large that it has about this width."""
ABOUT_AS_WELL = 0.75
"""Mixes of colours that show the line by this share of the best are compared by what they know of its centres."""
KNOWN_PX, FLANKS_ALONE = 0.03, 0.5
SURE = 3.5
"""Least amplitude of a stripe in its standard deviations."""
FAINTEST = 0.35
"""Least score of a line that is looked for further."""


class CoarseLines(NamedTuple):
    """What a coarse look at a plane gave: candidates, the chain through them, and by how many px rows were blurred."""

    found: Candidates
    chain: StripeChain
    along: float


def coarse(value: NDArray[np.float32]) -> CoarseLines:
    """Candidates and chain through some rows of a plane (lines, n), of at most COARSE_COLUMNS pixels. Where there is
    hardly a line to see, rows are blurred more: what is noisy is often straight."""
    look = _coarse(value, ALONG)
    if look.chain.score > WEAK_SCORE:
        return look
    further = _coarse(value, FAR_ALONG)
    return further if further.chain.score > 1.2 * look.chain.score else look


def _coarse(value: NDArray[np.float32], along: float) -> CoarseLines:
    step = max(1, len(value) // COARSE_ROWS)
    calm = cv2.GaussianBlur(value, (1, 2 * int(2.5 * along) + 1), sigmaX=0.0, sigmaY=along)
    part: NDArray[np.float32] = np.ascontiguousarray(calm[::step], dtype=np.float32)
    shrink = -(-part.shape[1] // COARSE_COLUMNS)
    if shrink > 1:
        size = (part.shape[1] // shrink, len(part))
        part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    found = candidates(part, np.arange(0, len(part)), SCALES, along=0.0)
    place = found.place * shrink + 0.5 * (shrink - 1)
    found = Candidates(found.rows * step, place, found.response, found.clear, found.scale * shrink)
    return CoarseLines(found, follow(found, step), along)


def choose_mix(picture: Picture, off: Picture | None, laser: LaserChannel) -> str:
    """The mix of colours in which a line stands out best among `MIXES`, or the one that `laser` names.

    Of the mixes that show it about as well, the one in which its centres are known best: a channel in which the core is
    saturated, or the noise or the texture strong, gives way to another.
    """
    if not picture.coloured or laser is not LaserChannel.AUTO:
        return laser.value if picture.coloured else "grey"
    looks = {mix: coarse(difference(picture, off, mix)[0]) for mix in MIXES}
    best = max(look.chain.score for look in looks.values())
    shown = [m for m, look in looks.items() if look.chain.score >= ABOUT_AS_WELL * best and len(look.chain.rows)]
    if len(shown) < 2:
        return shown[0] if shown else "grey"
    return max(
        shown, key=lambda mix: _knowledge(*difference(picture, off, mix), looks[mix].found, looks[mix].chain, mix)
    )


def _knowledge(
    value: NDArray[np.float32], usable: NDArray[np.bool_], shade: NDArray[np.float32] | None, found: Candidates,
    chain: StripeChain, mix: str,
) -> float:  # fmt: skip
    """How much the lines of a chain say about their centres, in 1/px², the sum of all that are worth a fit."""
    rows, at = found.rows[chain.rows], found.place[chain.rows, chain.which]
    scale = float(np.median(found.scale[chain.rows, chain.which]))
    k = max(1, int(scale / BINNED_WIDTH))
    plane, at, width = binned(Plane(value, usable, shade), k), (at - 0.5 * (k - 1)) / k, scale / k
    noise = surrounded(plane, rows, at, 4 * width, Noise(0.1, 1 / 40 * float(np.abs(MIXES[mix]).sum())))
    fitted = fit_shape(plane, rows, at, shape=gaussian(width, 4 * width + 3), noise=noise, scale_prior=FREE_SCALE)
    good = fitted.good & (fitted.amplitude > SURE * fitted.amplitude_sigma)
    good &= np.abs(fitted.centre - at) < np.maximum(2.0, 1.5 * width)
    variance, correlation, _ = around(plane, rows, np.where(fitted.good, fitted.centre, at), 4 * width)
    sigma = carried(fitted, variance, correlation)[good] * k * np.sqrt(np.maximum(1.0, fitted.chi2[good]))
    # A line that is known very well says no more than that it is; flanks are a poorer witness than a whole profile.
    core = np.abs(fitted.x[good]) < width
    hidden = np.asarray(core & np.isinf(fitted.variance[good])).any(axis=1)
    return float(np.sum((1 - FLANKS_ALONE * hidden) / (KNOWN_PX**2 + sigma**2)))


def difference(
    picture: Picture, off: Picture | None, mix: str
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32] | None]:
    """The plane, the pixels that can be used, and what was taken off it."""
    value, usable = picture.plane(mix)
    if off is None:
        return value, usable, None
    shade, fine = off.plane(mix)
    return value - shade, usable & fine, shade


APART = 4.0
"""Widths beside the line from which on another one begins."""


def without_line(found: Candidates, chain: StripeChain) -> Candidates:
    """The candidates of which those within APART widths of the line that was followed count nothing."""
    width = float(np.median(found.scale[chain.rows, chain.which]))
    own = np.interp(np.arange(len(found.rows)), chain.rows, found.place[chain.rows, chain.which])
    return replace(found, clear=np.where(np.abs(found.place - own[:, None]) > APART * width, found.clear, 0.0))
