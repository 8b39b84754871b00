"""The stripe followed as a line: of all that looks like a stripe in each row, the chain that runs through the picture.

A row's response is how far a spot stands above *both* its sides, so that an edge of the scene answers little.
Candidates of neighbouring rows are chained by dynamic programming: a chain may bend and have gaps; a jump, such as a
step of the surface makes, costs as much as several clear rows are worth.

Which of two peaks in a line is the stripe, and how wide the stripe is about there: what only the neighbours tell.

A reflection may be brighter than the stripe in some lines. There, the lines around that show one peak only say where
the stripe runs; where they say nothing, the peak with more energy stays, and the line is marked."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.vision.stripe.ordinary.find import CENTRE, ENERGY, WIDTH

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
    """How far, in DN, each place of `picture` (m, n) stands above both its sides, for a stripe of σ `scale` px.

    Rows are blurred by `along` px.
    """
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

    Neighbouring rows are blurred by `along` px.
    """
    n = part.shape[1]
    best = np.full(part.shape, -np.inf, np.float32)
    answer = np.zeros(part.shape, np.float32)
    of = np.zeros(part.shape, np.uint8)
    for k, scale in enumerate(scales):
        if 6 * scale > n:
            continue
        response = respond(part, scale, along)
        _take_better(response, np.float32(_noise(response)), k, best=best, answer=answer, of=of)
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
    """Where `response` over `noise` is above `best` (m, n): takes it, and notes the answer and the scale's number."""
    for row in range(response.shape[0]):
        for column in range(response.shape[1]):
            clear = response[row, column] / noise
            if clear > best[row, column]:
                best[row, column], answer[row, column], of[row, column] = clear, response[row, column], k


def _noise(response: NDArray[np.float32]) -> float:
    """Scatter of what answers where nothing is, which is the middle of all answers."""
    few = response[:: max(1, len(response) // 128), :: max(1, response.shape[1] // 512)]
    low, middle = np.percentile(few, (30, 50))
    return max(float(middle - low) / 0.5244, 0.05)


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
    end = int(best.argmax())
    r, k = divmod(end, CANDIDATES)
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


DOUBLE = 0.5
"""Energy of the weaker peak over that of the stronger from which a line is marked as double."""
RIVAL = 0.15
# Lines on either side that are asked where the stripe runs, how many of them at most, and how near it has to be.
REACH, ASKED, NEAR = 30, 7, 4.0
SMOOTHED = 7


def choose(start: Array) -> NDArray[np.bool_]:
    """True (lines,) where two peaks compete; `start` (lines, 2, …) is put in order, the chosen one first."""
    energy = start[:, :, ENERGY]
    rival = energy[:, 1] > RIVAL * energy[:, 0]
    double: NDArray[np.bool_] = energy[:, 1] > DOUBLE * energy[:, 0]
    if not rival.any():
        return double
    alone = np.flatnonzero((energy[:, 0] > 0) & ~rival)
    for line in np.flatnonzero(rival):
        here = np.searchsorted(alone, line)
        sides = (alone[max(0, here - ASKED) : here], alone[here : here + ASKED])
        asked = np.concatenate([side[np.abs(side - line) <= REACH] for side in sides])
        if len(asked) < 3:
            continue
        slope, middle = _line_through(asked - line, start[asked, 0, CENTRE])
        away = np.abs(start[line, :, CENTRE] - middle)
        tolerance = NEAR + 0.5 * abs(slope) + start[line, 0, WIDTH]
        if away[1] < tolerance < away[0]:
            start[line] = start[line, ::-1]
            double[line] = True
    return double


def _line_through(x: Array, y: Array) -> tuple[float, float]:
    """Slope and value at 0 of a line that one bad point in four does not move: medians of slopes and of values."""
    i, j = np.triu_indices(len(x), 1)
    slope = float(np.median((y[j] - y[i]) / (x[j] - x[i])))
    return slope, float(np.median(y - slope * x))


@compiled
def survey(start: Array, low: float, high: float) -> tuple[NDArray[np.int64], Array]:
    """What the lines say together: those found (m,) and how wide the stripe is about each line (lines,).

    The width in px is the running mean over 15 lines of the start widths within low … high, which are counts of pixels
    and coarse one by one.
    """
    lines = len(start)
    found = np.empty(lines, np.int64)
    # Sums over the lines before each.
    totals, counts = np.zeros(lines + 1), np.zeros(lines + 1, np.int64)
    for r in range(lines):
        totals[r + 1], counts[r + 1] = totals[r], counts[r]
        if start[r, 0, ENERGY] > 0:
            totals[r + 1] += min(max(start[r, 0, WIDTH], low), high)
            found[counts[r]] = r
            counts[r + 1] += 1
    widths = np.empty(lines)
    overall = totals[lines] / counts[lines] if counts[lines] > 0 else min(max(1.0, low), high)
    for r in range(lines):
        first, end = max(0, r - SMOOTHED), min(lines, r + SMOOTHED + 1)
        here = counts[end] - counts[first]
        widths[r] = (totals[end] - totals[first]) / here if here > 0 else overall
    return found[: counts[lines]], widths
