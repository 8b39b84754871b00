"""The stripe of a picture of which nothing is known but that a line laser was on: how it runs, and in which colour."""

from __future__ import annotations

from typing import Any

from cell.measure.vision.stripe.careful.confidence import refuse_unsure
from cell.measure.vision.stripe.extract import Axis, LaserChannel, StripeProfile, StripeSettings, extract, subtracted
from cell.measure.vision.stripe.overview import LEAST_SCORE, CoarseLines, choose_mix, coarse

LEAST_POINTS = 30


def read_stripe(
    image: Any, off: Any = None, laser: LaserChannel | str = LaserChannel.AUTO, settings: StripeSettings | None = None
) -> StripeProfile | None:
    """The stripe of `image` (h, w), (h, w, 3) or (h, w, 4), red first, along rows or columns, whichever it follows.

    `off` is a picture of the same view without the laser, `laser` the channel to read it in. None where no line of
    LEAST_POINTS points is found. Raises what `extract` raises, and PictureRefused where it is not sure which line is
    the laser's.
    """
    settings, laser = settings or StripeSettings(), LaserChannel(laser)
    picture, dark = subtracted(image, off, settings)
    looks: dict[Axis, tuple[CoarseLines, str]] = {}
    for axis in ("rows", "columns"):
        part = picture if axis == "rows" else picture.turned()
        shade = None if dark is None else (dark if axis == "rows" else dark.turned())
        mix = choose_mix(part, shade, laser)
        value = part.plane(mix)[0] if shade is None else part.plane(mix)[0] - shade.plane(mix)[0]
        looks["rows" if axis == "rows" else "columns"] = coarse(value), mix
    best = max(looks, key=lambda axis: looks[axis][0].chain.score)
    if looks[best][0].chain.score < LEAST_SCORE:
        return None
    refuse_unsure(*looks[best])
    profile = extract(image, off, best, settings, laser=laser)
    return profile if len(profile.rows) >= LEAST_POINTS else None
