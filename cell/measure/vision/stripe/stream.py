"""The stripe in pictures that stream by, such as a sweep's: what they have in common is measured in some of them.

Laser, lens and surface make the speckle, camera and exposure the noise, not the single picture: both are measured in
the first picture of every `BLOCK` and hold for the others of the block, which saves a third of the time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.extract import Axis, Image, StripeProfile, StripeSettings, extract

BLOCK = 16
"""Pictures for which what was measured holds: 1.6 mm of a sweep at .1 mm a profile."""

Dark = NDArray[np.floating[Any]] | NDArray[np.uint8]


class StripeStream:
    """`extract` for one picture after the other of a stream, all of one size and axis."""

    def __init__(self, dark: Dark | None = None, axis: Axis = "rows", settings: StripeSettings | None = None) -> None:
        self._dark = dark
        self._axis = axis
        self._settings = settings
        self._like: StripeProfile | None = None
        self._seen = 0

    def extract(self, image: Image) -> StripeProfile:
        """The profile of the next picture (h, w); raises what `extract` raises."""
        if self._seen % BLOCK == 0:
            self._like = None
        profile = extract(image, self._dark, self._axis, self._settings, like=self._like)
        # A block's first picture that shows too few lines, such as a covered one, says nothing of the others.
        told = profile.speckle is not None or profile.learned is not None
        self._like = profile if told else replace(profile, noise=None)
        self._seen += 1
        return profile
