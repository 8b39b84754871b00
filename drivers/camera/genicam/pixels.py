"""From the pixels that a camera sends to 8-bit grey.

Formats and their numbers are those of the Pixel Format Naming Convention (EMVA, 2.1); the two packings of GigE Vision
("Packed") differ from the convention's own ("p"). What has more than 8 bits keeps its highest 8.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import Image

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class PixelFormat:
    """A format: its number on the wire, bits a pixel, and what makes (height, width) grey of its bytes."""

    code: int
    bits: int
    grey: Callable[[Bytes, int, int], Image]


def _mono8(data: Bytes, height: int, width: int) -> Image:
    return data.reshape(height, width)


def _high_byte(shift: int) -> Callable[[Bytes, int, int], Image]:
    """Unpacked pixels of two bytes, little-endian, of which `shift` bits are below the highest 8."""

    def grey(data: Bytes, height: int, width: int) -> Image:
        return (data.view("<u2") >> shift).astype(np.uint8).reshape(height, width)

    return grey


def _packed(data: Bytes, height: int, width: int) -> Image:
    """GigE Vision's packing: two pixels in three bytes, the highest 8 bits of each in the first and the last."""
    return np.ascontiguousarray(data.reshape(-1, 3)[:, ::2]).reshape(-1)[: height * width].reshape(height, width)


def _mono10p(data: Bytes, height: int, width: int) -> Image:
    """Four pixels in five bytes, the lowest bits first."""
    five = data.reshape(-1, 5).astype(np.uint16)
    high = [(five[:, k] >> (2 + 2 * k)) | (five[:, k + 1] << (6 - 2 * k)) for k in range(4)]
    return np.stack(high, axis=1).astype(np.uint8).reshape(-1)[: height * width].reshape(height, width)


def _mono12p(data: Bytes, height: int, width: int) -> Image:
    """Two pixels in three bytes, the lowest bits first."""
    three = data.reshape(-1, 3)
    high = np.empty((len(three), 2), np.uint8)
    high[:, 0] = (three[:, 0] >> 4) | (three[:, 1] << 4)
    high[:, 1] = three[:, 2]
    return high.reshape(-1)[: height * width].reshape(height, width)


def _colour(code: int, channels: int) -> Callable[[Bytes, int, int], Image]:
    """Through OpenCV's conversion `code`."""

    def grey(data: Bytes, height: int, width: int) -> Image:
        shape = (height, width) if channels == 1 else (height, width, channels)
        return cv2.cvtColor(data.reshape(shape), code).astype(np.uint8, copy=False)

    return grey


# OpenCV names a Bayer pattern by its second row's second and third pixel, the convention by its first row's first two.
FORMATS = {
    "Mono8": PixelFormat(0x01080001, 8, _mono8),
    "Mono10": PixelFormat(0x01100003, 16, _high_byte(2)),
    "Mono10Packed": PixelFormat(0x010C0004, 12, _packed),
    "Mono10p": PixelFormat(0x010A0046, 10, _mono10p),
    "Mono12": PixelFormat(0x01100005, 16, _high_byte(4)),
    "Mono12Packed": PixelFormat(0x010C0006, 12, _packed),
    "Mono12p": PixelFormat(0x010C0047, 12, _mono12p),
    "Mono16": PixelFormat(0x01100007, 16, _high_byte(8)),
    "BayerGR8": PixelFormat(0x01080008, 8, _colour(cv2.COLOR_BayerGB2GRAY, 1)),
    "BayerRG8": PixelFormat(0x01080009, 8, _colour(cv2.COLOR_BayerBG2GRAY, 1)),
    "BayerGB8": PixelFormat(0x0108000A, 8, _colour(cv2.COLOR_BayerGR2GRAY, 1)),
    "BayerBG8": PixelFormat(0x0108000B, 8, _colour(cv2.COLOR_BayerRG2GRAY, 1)),
    "RGB8": PixelFormat(0x02180014, 24, _colour(cv2.COLOR_RGB2GRAY, 3)),
    "BGR8": PixelFormat(0x02180015, 24, _colour(cv2.COLOR_BGR2GRAY, 3)),
}
"""The formats that can be configured, by the convention's names."""
NAMES = {known.code: name for name, known in FORMATS.items()}


def size_in_bytes(name: str, height: int, width: int) -> int:
    """How many bytes a picture has without padding; a group of packed pixels is always whole."""
    group = {"Mono10Packed": (2, 3), "Mono12Packed": (2, 3), "Mono12p": (2, 3), "Mono10p": (4, 5)}.get(name)
    if group is None:
        return height * width * FORMATS[name].bits // 8
    pixels, size = group
    return -(-height * width // pixels) * size


def to_grey(name: str, data: Bytes, height: int, width: int) -> Image:
    """The picture (height, width) uint8 of `data`, bytes in the format `name`; ValueError when there are too few."""
    expected = size_in_bytes(name, height, width)
    if len(data) < expected:
        raise ValueError(f"a picture of {width}x{height} pixels in {name} has {len(data)} of {expected} bytes")
    return FORMATS[name].grey(data[:expected], height, width)
