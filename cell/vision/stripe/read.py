"""The stripe of a picture of which nothing is known but that a line laser was on: how it runs, and in which colour."""

from __future__ import annotations

from typing import Any

from cell.vision.stripe.careful import LEAST_SCORE, choose_mix, coarse
from cell.vision.stripe.extract import Axis, Laser, StripeProfile, StripeSettings, extract, subtracted

LEAST_POINTS = 30


def read_stripe(
    image: Any, off: Any = None, laser: Laser | str = Laser.AUTO, settings: StripeSettings | None = None
) -> StripeProfile | None:
    """The stripe of `image` (h, w), (h, w, 3) or (h, w, 4), red first, along rows or columns, whichever it follows.

    `off` is a picture of the same view without the laser, `laser` the channel to read it in. None where no line of
    LEAST_POINTS points is found. Raises what `extract` raises.
    """
    settings, laser = settings or StripeSettings(), Laser(laser)
    picture, dark = subtracted(image, off, settings)
    scores: dict[Axis, float] = {}
    for axis in ("rows", "columns"):
        part = picture if axis == "rows" else picture.turned()
        shade = None if dark is None else (dark if axis == "rows" else dark.turned())
        mix = choose_mix(part, shade, laser)
        value = part.plane(mix)[0] if shade is None else part.plane(mix)[0] - shade.plane(mix)[0]
        scores["rows" if axis == "rows" else "columns"] = coarse(value).chain.score
    best = max(scores, key=lambda axis: scores[axis])
    if scores[best] < LEAST_SCORE:
        return None
    profile = extract(image, off, best, settings, laser=laser)
    return profile if len(profile.rows) >= LEAST_POINTS else None
