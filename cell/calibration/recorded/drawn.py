"""Pictures that a program drew into or straightened: the same view once more, which must not count twice.

Corners, axes and markers are found by their pixels: thin lines of pure colours over an otherwise identical picture.
What a straightened copy shows differs everywhere a little: there its name has to say it, too.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.calibration.recorded.places import named_lit
from cell.vision.pictures import PictureRefused, Reason
from cell.vision.stripe.planes import read_colours

if TYPE_CHECKING:
    from cell.calibration.recorded.folder import RecordedFrame

SMALL = (40, 30)
ALIKE_DN = 12.0
"""Small copies of one view differ by less on average; which views are worth a closer look."""
SAME_DN, CHANGED_DN = 6.0, 40
"""Half of the pixels differ by less than the first; what differs by more than the second was drawn."""
LARGEST_SHARE = 0.2
COLOURED_DN, COLOURED_SHARE = 60, 0.6
"""Drawn pixels are by so much more coloured than before; most of them are."""
THICK = 80
"""Lines are thinner than the picture's width over this."""
HUES, HUE_SHARE = 6, 0.15
"""A laser's line has one hue; axes, markers and corners have several, or are at most of the board's points."""
AT_POINTS, NEAR_PX = 0.6, 6
STRAIGHTENED = re.compile(r"undist|rectif|remap|straight", re.IGNORECASE)


def small_copy(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A picture (h, w) as few numbers (n,): its small copy."""
    return cv2.resize(image, SMALL, interpolation=cv2.INTER_AREA).astype(np.float32).ravel()


def set_copies_aside(frames: Sequence[RecordedFrame], small: Sequence[NDArray[np.float32] | None]) -> None:
    """Refuse frames that are others with something drawn in, or straightened; `small` copies (n,) by frame."""
    for k, frame in enumerate(frames):
        for j, other in enumerate(frames):
            mine, its = small[k], small[j]
            if j == k or mine is None or its is None or frame.reason is Reason.DUPLICATE or other.shows is not None:
                continue
            if np.abs(mine - its).mean() > ALIKE_DN:
                continue
            if STRAIGHTENED.search(frame.name) and not STRAIGHTENED.search(other.name):
                text = f"by its name it is {other.name}, straightened"
            elif not named_lit(frame) and drawn_into(frame, other):
                text = f"it is {other.name} with lines drawn into it"
            else:
                continue
            frame.shows = other
            frame.refuse(Reason.DUPLICATE, text)


def drawn_into(frame: RecordedFrame, other: RecordedFrame) -> bool:
    """True where a frame's picture is the other's with thin coloured lines over it."""
    try:
        drawn, plain = (_coloured(read_colours(f.path)) for f in (frame, other))
    except PictureRefused:
        return False
    if drawn.shape != plain.shape:
        return False
    apart = cv2.absdiff(drawn, plain).max(axis=2)
    changed = apart > CHANGED_DN
    if not 0 < changed.mean() < LARGEST_SHARE or np.median(apart) > SAME_DN:
        return False
    more = np.ptp(drawn.astype(np.int16), axis=2) - np.ptp(plain.astype(np.int16), axis=2)
    lines = changed & (more > COLOURED_DN)
    thick = cv2.erode(changed.astype(np.uint8), np.ones((max(5, drawn.shape[1] // THICK),) * 2, np.uint8))
    if lines.sum() < COLOURED_SHARE * changed.sum() or thick.sum() > 0.1 * changed.sum():
        return False
    hue = cv2.cvtColor(drawn, cv2.COLOR_RGB2HSV)[:, :, 0][lines]
    # Hues count to 180; each primary in the middle of its part.
    parts = np.bincount((hue.astype(int) + 90 // HUES) % 180 * HUES // 180, minlength=HUES)
    if (parts > HUE_SHARE * len(hue)).sum() > 1:
        return True
    view = frame.view or other.view
    if view is None:
        return False
    near = cv2.dilate(lines.astype(np.uint8), np.ones((2 * NEAR_PX + 1,) * 2, np.uint8))
    at = np.clip(np.round(view.pixels).astype(int), 0, np.array(view.size) - 1)
    return float(near[at[:, 1], at[:, 0]].mean()) > AT_POINTS


def _coloured(image: NDArray[np.uint8] | NDArray[np.uint16]) -> NDArray[np.uint8]:
    """A picture (h, w, 3) of 8 bits, red first."""
    eight = (image >> 8).astype(np.uint8) if image.dtype == np.uint16 else np.asarray(image, dtype=np.uint8)
    return np.repeat(eight[:, :, None], 3, axis=2) if eight.ndim == 2 else np.ascontiguousarray(eight[:, :, :3])
