"""Whether a picture is worth looking at: readable, whole, of the right size, neither black nor blinded.

Each refusal has a short reason for scripts and a text for people. What is in the picture is `board.py`'s business.
"""

from enum import StrEnum
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import RefusedError

Image = NDArray[np.uint8]
Taken = Image | NDArray[np.uint16]
"""A picture as a camera takes it, grey or in colours."""
Dark = Taken | NDArray[np.float32] | NDArray[np.float64]
"""One without the laser, or the mean of several."""
Found = TypeVar("Found")

BLACK_DN = 10
SATURATED_SHARE = 0.6


class Reason(StrEnum):
    """Why a picture was refused."""

    UNREADABLE = "unreadable"
    CUT = "cut"
    WRONG_SIZE = "wrong_size"
    BLACK = "black"
    SATURATED = "saturated"
    NO_BOARD = "no_board"
    AMBIGUOUS = "ambiguous"
    MIRRORED = "mirrored"
    TURNED = "turned"
    OBLIQUE = "oblique"
    RESIDUAL = "residual"
    NO_POSE = "no_pose"
    DUPLICATE = "duplicate"
    LASER_PICTURE = "laser_picture"


class PictureRefused(RefusedError):
    """A picture cannot be used; `reason` is for scripts, the text for people."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = reason

    def __reduce__(self) -> tuple[object, ...]:
        return (type(self), (self.reason, str(self)))


def read_picture(path: Path) -> Image:
    """The grey 8-bit image (h, w) of a file, as the sensor has it; refuses unreadable and cut files."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PictureRefused(Reason.UNREADABLE, f"{path.name} cannot be read: {error.strerror}") from error
    if _is_cut(data):
        raise PictureRefused(
            Reason.CUT, f"{path.name} is cut: its end is missing after {len(data)} bytes; copy it again"
        )
    if data.startswith(b"version https://git-lfs"):
        raise PictureRefused(
            Reason.UNREADABLE,
            f"{path.name} only points to a picture that was not fetched (Git LFS): run `git lfs pull`",
        )
    image: NDArray[np.generic] | None = None
    if data:
        # The lens belongs to the sensor: however the camera was held, the picture is read as the sensor has it.
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            raise PictureRefused(Reason.UNREADABLE, f"{path.name} cannot be decoded: {error.err}") from error
    if image is None:
        raise PictureRefused(Reason.UNREADABLE, f"{path.name} is no picture that can be decoded ({len(data)} bytes)")
    return _eight_bit(image, path)


def _eight_bit(image: NDArray[np.generic], path: Path) -> Image:
    """The picture with 8 bit: of 10, 12, 14 and 16 bit the uppermost eight."""
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    if image.dtype != np.uint16:
        raise PictureRefused(
            Reason.UNREADABLE, f"{path.name} holds numbers of the kind {image.dtype}, as a depth picture does"
        )
    bits = next(b for b in (8, 10, 12, 14, 16) if int(image.max()) < 1 << b)
    return np.asarray(np.asarray(image, dtype=np.uint16) >> (bits - 8), dtype=np.uint8)


def check_picture(image: Image) -> None:
    """Refuse an image (h, w) that is black or blinded."""
    # A thin laser line must not make a black picture pass, hence a high percentile and not the maximum.
    counts = counts_of(image)
    bright = percentile(counts, 95)
    if bright < BLACK_DN:
        raise PictureRefused(
            Reason.BLACK, f"the picture is black: 95 % of it below {bright:.0f} of 255; open the shutter or add light"
        )
    blinded = float(counts[254:].sum()) / image.size
    if blinded > SATURATED_SHARE:
        raise PictureRefused(
            Reason.SATURATED, f"the picture is saturated: {blinded:.0%} of it is white; shorten the exposure"
        )


def counts_of(image: Image) -> NDArray[np.int64]:
    """How many pixels of an image (h, w) have each of the 256 grey values."""
    made = cv2.calcHist([np.ascontiguousarray(image)], [0], None, [256], [0, 256])
    return np.rint(made).astype(np.int64).ravel()


def percentile(counts: NDArray[np.int64], share: float) -> float:
    """The grey value below which `share` percent of so many pixels lie, as `np.percentile` has it, without sorting."""
    reached = np.cumsum(counts)
    at = (int(reached[-1]) - 1) * share / 100
    low, high = np.searchsorted(reached, (np.floor(at), np.ceil(at)), side="right").tolist()
    return float(low + (high - low) * (at - np.floor(at)))


def _is_cut(data: bytes) -> bool:
    """True for a PNG or JPEG whose end mark is missing, and for a BMP shorter than it says."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-16:]
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" not in data[_jpeg_scan(data) :]
    if data.startswith(b"BM") and len(data) > 6:
        return int.from_bytes(data[2:6], "little") > len(data)
    return False


def _jpeg_scan(data: bytes) -> int:
    """Where the picture itself begins in a JPEG: behind its headers, whose preview has an end mark of its own.
    Telephones write further data behind the picture, so the end mark need not be near the file's end."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return at


def only_one(found: list[Found], name: str) -> Found:
    """The one board found; refuses two that could both be meant rather than choose between them."""
    if len(found) > 1:
        raise PictureRefused(
            Reason.AMBIGUOUS, f"{len(found)} boards that could be {name} are in view; cover or remove all but one"
        )
    return found[0]
