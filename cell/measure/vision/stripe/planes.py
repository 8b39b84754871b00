"""Pictures as cameras make them, as planes to read a stripe from: mono, colour, with alpha; of 8, 12 or 16 bits.

A plane is in DN of an 8-bit picture, as numbers with a fraction, whatever the camera counts in. Colours come red first.

The noise of one pixel, seen in the picture: what a line's neighbours differ by, above the declared photon noise."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cell.base.compiled import compiled
from cell.measure.vision.pictures import Image, PictureRefused, Reason, Taken

FULL = 255.0
NEAR_FULL = 0.985
"""From this share of the range on a pixel is taken to be saturated; the coding of a JPEG moves it that much."""


class LaserChannel(StrEnum):
    """Where in the picture the laser is looked for: in what it stands out best, or where one says that it is."""

    AUTO = "auto"
    RED = "red"
    GREEN = "green"
    BLUE = "blue"
    GREY = "grey"
    RED_OVER_OTHERS = "red over green and blue"
    GREEN_OVER_OTHERS = "green over red and blue"
    BLUE_OVER_OTHERS = "blue over red and green"
    GREEN_OVER_RED = "green over red"
    RED_OVER_GREEN = "red over green"


MIXES: dict[str, tuple[float, float, float]] = {
    "grey": (1 / 3, 1 / 3, 1 / 3),
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
    "red over green and blue": (1.0, -0.5, -0.5),
    "green over red and blue": (-0.5, 1.0, -0.5),
    "blue over red and green": (-0.5, -0.5, 1.0),
    "green over red": (-1.0, 1.0, 0.0),
    "red over green": (1.0, -1.0, 0.0),
}
"""Shares of red, green and blue. Differences take away what is white: lamps, paper, what shines."""


@dataclass(frozen=True)
class Picture:
    """A picture (h, w) or (h, w, 3), red first, in DN of 8 bits, and its `saturated` pixels, of the same shape."""

    value: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    plain: bool
    """True of an 8-bit picture of one channel, which needs nothing of all this."""
    full: float = FULL
    """What the camera counts at the end of its range."""

    @property
    def coloured(self) -> bool:
        """True when the three colours differ."""
        return self.value.ndim == 3

    def rows(self, part: slice) -> "Picture":
        """Some rows of it."""
        return Picture(self.value[part], self.saturated[part], self.plain, self.full)

    def turned(self) -> "Picture":
        """The picture with its columns as rows."""
        turn = (1, 0, 2) if self.coloured else (1, 0)
        value = np.ascontiguousarray(self.value.transpose(turn))
        saturated = np.ascontiguousarray(self.saturated.transpose(turn))
        return Picture(value, saturated, self.plain, self.full)

    def plane(self, mix: str) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """The plane (h, w) of one of `MIXES` and the pixels (h, w) that can be used in it."""
        if self.value.ndim == 2:
            return self.value, ~self.saturated
        shares = np.array(MIXES[mix], np.float32)
        value = np.ascontiguousarray(self.value @ shares)
        return value, np.asarray(~self.saturated[:, :, shares != 0].any(axis=2))


def read_colours(path: Path) -> Taken:
    """The picture of a file as it was taken: (h, w), or (h, w, 3) with red first; 8 or 16 bits. Raises `PictureRefused`
    for a file that is no picture."""
    # As the sensor has it, however the camera was held: `read_picture` reads it so, too.
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image: Any = cv2.imread(str(path), flags)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise PictureRefused(Reason.UNREADABLE, f"{path.name} is no picture of 8 or 16 bits; give a PNG, JPEG or TIFF")
    if image.ndim == 2:
        return image  # type: ignore[no-any-return]
    return np.ascontiguousarray(image[:, :, 2::-1] if image.shape[2] >= 3 else image[:, :, 0])


def as_picture(image: ArrayLike, saturation: float = FULL, full: float | None = None) -> Picture:
    """A picture (h, w), (h, w, 1), (h, w, 3) or (h, w, 4) of uint8 or uint16, red first, alpha left out.

    12 bits in 16 may lie at either end, 10 and 14 as well: the range is taken from the values. `saturation` is in DN
    of 8 bits, `full` the end of the range where it is known. Raises ValueError for any other type or shape.
    """
    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(
            f"the stripe needs an 8-bit or 16-bit picture, grey or RGB, not {image.dtype} of shape {image.shape}"
        )
    if image.ndim == 3 and image.shape[2] not in (1, 3, 4):
        raise ValueError(f"the picture has {image.shape[2]} channels; allowed are 1 (grey), 3 (RGB) and 4 (RGBA)")
    if image.ndim == 3:
        image = image[:, :, 0] if image.shape[2] == 1 else image[:, :, :3]
    if image.ndim == 3 and _grey(image):
        image = np.ascontiguousarray(image[:, :, 0])
    if image.dtype == np.uint8:
        limit = min(saturation, NEAR_FULL * FULL) if image.ndim == 3 else saturation
        return Picture(image.astype(np.float32), image >= limit, image.ndim == 2)
    full = full or range_of(image)
    value = image.astype(np.float32) * np.float32(FULL / full)
    return Picture(value, image >= NEAR_FULL * full * min(1.0, saturation / FULL), False, full)


def range_of(image: Taken) -> int:
    """The value of a saturated pixel of a picture of 16-bit numbers: of 10, 12, 14 or 16 bits, at either end."""
    top = int(image.max())
    together = int(np.bitwise_or.reduce(image, axis=None))
    spare = (together & -together).bit_length() - 1 if together else 0
    if spare >= 2 and top > 4095:
        # The low bits are never set: the number lies at the upper end.
        return 65535 - (1 << spare) + 1
    for bits in (10, 12, 14):
        # Fewer than eight bits' worth of light would be a dark picture of a deeper camera.
        if top < 1 << bits:
            return (1 << bits) - 1
    return 65535


def _grey(image: Taken) -> bool:
    few = image[::7, ::7]
    if not (np.array_equal(few[:, :, 0], few[:, :, 1]) and np.array_equal(few[:, :, 0], few[:, :, 2])):
        return False
    return bool((image[:, :, 0] == image[:, :, 1]).all() and (image[:, :, 0] == image[:, :, 2]).all())


SAMPLED_LINES = 5
# The declared noise is believed up to an excess of this share: the stripe's own flanks look like noise.
DOUBT = 0.3


@compiled
def trimmed_square(counts: NDArray[np.int64], total: int) -> float:
    """Mean square of `total` sizes, of which there are `counts`: structure makes large ones, which are left out."""
    median, below = 0, int(counts[0])
    while 2 * below < total:
        median += 1
        below += int(counts[median])
    kept, squares = 0, 0.0
    for size in range(min(len(counts), 4 * (median + 1) + 1)):
        kept += counts[size]
        squares += float(counts[size]) * size * size
    return squares / max(kept, 1)


@compiled
def pixel_noise(image: Image, gain_dn: float, declared_dn2: float) -> tuple[float, float]:
    """(variance without photons, whole variance) of a pixel of an 8-bit image's background, DN². The first is at least
    `declared_dn2`, more where the picture is noisier than its photons explain."""
    lines, n = image.shape
    # Neighbours two by two, counted by how far they differ.
    counts = np.zeros(256, np.int64)
    total, pairs = 0, 0
    for r in range(0, lines, max(1, lines // SAMPLED_LINES)):
        for i in range(0, n - 1, 2):
            one, other = np.int64(image[r, i]), np.int64(image[r, i + 1])
            counts[abs(one - other)] += 1
            total += int(one + other)
        pairs += n // 2
    whole = trimmed_square(counts, pairs) / 2
    excess = whole - gain_dn * (total / (2 * pairs)) - declared_dn2
    return declared_dn2 + (excess if excess > DOUBT * whole else 0.0), max(declared_dn2, whole)
