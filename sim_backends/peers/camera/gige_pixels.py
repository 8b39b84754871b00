"""Grey pictures in the pixel formats of a GigE Vision camera, as its sensor would send them.

Source: Pixel Format Naming Convention 2.1 and GigE Vision 1.2, "pixel formats". 10 and 12 bits are the grey's 8 with
noughts below; a colour sensor sees grey as equal parts of its colours.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]


def _plain(image: Grey) -> bytes:
    return image.tobytes()


def _words(bits: int) -> Callable[[Grey], bytes]:
    return lambda image: (image.astype("<u2") << (bits - 8)).tobytes()


def _packed(bits: int) -> Callable[[Grey], bytes]:
    """Two pixels in three bytes: high bits of the first, low ones of both, high bits of the second."""

    def encode(image: Grey) -> bytes:
        values = _pairs(image, 2).astype(np.uint16) << (bits - 8)
        low = (1 << (bits - 8)) - 1
        middle = ((values[:, 1] & low) << 4) | (values[:, 0] & low)
        return np.stack([values[:, 0] >> (bits - 8), middle, values[:, 1] >> (bits - 8)], 1).astype(np.uint8).tobytes()

    return encode


def _stream_of_bits(bits: int) -> Callable[[Grey], bytes]:
    """Pixels one after the other, the lowest bit first."""

    def encode(image: Grey) -> bytes:
        values = _pairs(image, 4).reshape(-1).astype(np.uint16) << (bits - 8)
        each = (values[:, None] >> np.arange(bits)) & 1
        return np.packbits(each.astype(np.uint8).reshape(-1), bitorder="little").tobytes()

    return encode


def _triple(image: Grey) -> bytes:
    return np.repeat(image.reshape(-1), 3).tobytes()


def _pairs(image: Grey, group: int) -> Grey:
    flat = image.reshape(-1)
    return np.concatenate([flat, np.zeros(-len(flat) % group, np.uint8)]).reshape(-1, group)


ENCODERS: dict[int, tuple[str, int, Callable[[Grey], bytes]]] = {
    0x01080001: ("Mono8", 8, _plain),
    0x01100003: ("Mono10", 16, _words(10)),
    0x010C0004: ("Mono10Packed", 12, _packed(10)),
    0x010A0046: ("Mono10p", 10, _stream_of_bits(10)),
    0x01100005: ("Mono12", 16, _words(12)),
    0x010C0006: ("Mono12Packed", 12, _packed(12)),
    0x010C0047: ("Mono12p", 12, _stream_of_bits(12)),
    0x01080009: ("BayerRG8", 8, _plain),
    0x02180014: ("RGB8", 24, _triple),
}
"""Format's number → name, bits a pixel, and its bytes from a grey picture."""
