"""Is the line that was followed the laser's? In grey, a faint stripe among bright things is easily passed by."""

from __future__ import annotations

import numpy as np

from cell.measure.vision.pictures import PictureRefused, Reason
from cell.measure.vision.stripe.careful.follow import LEAST, MOST, Candidates, StripeChain, follow
from cell.measure.vision.stripe.overview import CoarseLines

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
