"""A first look at a picture: how the laser's line runs in some of its rows, and in which mix of colours it stands out.

What it finds is followed through all rows and measured by the careful way (`careful.py`).

Is the line that was followed the laser's? In grey, a faint stripe among bright things is easily passed by."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.pictures import PictureRefused, Reason
from cell.measure.vision.stripe.careful.follow import LEAST, MOST, SCALES, Candidates, StripeChain, candidates, follow
from cell.measure.vision.stripe.careful.learning import FREE_SCALE
from cell.measure.vision.stripe.careful.shaped_fit import Noise, Plane, binned, fit_shape, gaussian
from cell.measure.vision.stripe.careful.surroundings import around, carried, surrounded
from cell.measure.vision.stripe.planes import MIXES, LaserChannel, Picture

Array = NDArray[np.float64]

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
LEAST_SCORE = 0.35


class CoarseLines(NamedTuple):
    """What a coarse look at a plane gave: candidates, the chain through them, and by how many px rows were blurred."""

    found: Candidates
    chain: StripeChain
    along: float


def coarse(value: NDArray[np.float32]) -> CoarseLines:
    """Candidates and chain through some rows of a plane (lines, n), of at most COARSE_COLUMNS pixels.

    Where there is hardly a line to see, rows are blurred more: what is noisy is often straight.
    """
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


CLEAR = 10.0
"""A line that says this much for itself, over noise and what else is in the picture, a row on average, is taken."""
MOST_RIVAL = 0.36
"""A fainter one only where the next best line says no more than this share of what it says. In pictures of seven
set-ups the right lines below CLEAR had at most 0.32, those of which an eighth or more was wrong 0.39 and more."""
APART = 4.0
"""Widths beside the line from which on another one begins."""


def rivalry(look: CoarseLines) -> float:
    """What the next best line of a picture says for itself, over what the one that was followed says."""
    found, chain = look.found, look.chain
    if not len(chain.rows):
        return 0.0
    width = float(np.median(found.scale[chain.rows, chain.which]))
    own = np.interp(np.arange(len(found.rows)), chain.rows, found.place[chain.rows, chain.which])
    clear = np.where(np.abs(found.place - own[:, None]) > APART * width, found.clear, 0.0)
    rest = Candidates(found.rows, found.place, found.response, clear, found.scale)
    return _said(rest, follow(rest)) / max(_said(found, chain), 1e-6)


def refuse_unsure(look: CoarseLines, mix: str) -> None:
    """Refuse a picture whose line is neither clear nor without a rival; `mix` is what it was looked for in."""
    rival = rivalry(look)
    if look.chain.score >= CLEAR or rival <= MOST_RIVAL:
        return
    raise PictureRefused(
        Reason.AMBIGUOUS,
        f"which line is the laser's is not sure: in {mix} the best has {look.chain.score:.1f} (sure from {CLEAR:.0f}), "
        f"another says {rival:.2f} of what it says, allowed {MOST_RIVAL}; give a colour picture, or that of the same "
        "view with the laser off, or darken the room",
    )


def _said(found: Candidates, chain: StripeChain) -> float:
    return float(np.sum(np.minimum(found.clear[chain.rows, chain.which], MOST) - LEAST))
