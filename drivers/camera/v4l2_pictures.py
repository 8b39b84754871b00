"""What a picture of a V4L2 camera is worth: its pixels as grey, and what its time stamp leaves open."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from drivers.interfaces import Image


@dataclass(frozen=True)
class ExposureTiming:
    """Exposure in s and frame rate in Hz."""

    exposure: float
    frame_rate: float

    @property
    def open_s(self) -> float:
        """By how much the exposure may have begun before the picture's stamp, s."""
        return self.exposure + 1.0 / self.frame_rate


def to_grey(raw: object, shape: tuple[int, int]) -> Image:
    """Grey (height, width) uint8 of what OpenCV read: grey as it is, the first plane of YUYV, or BGR converted."""
    if not isinstance(raw, np.ndarray) or raw.dtype != np.uint8:
        raise ValueError(f"a picture is {getattr(raw, 'dtype', type(raw).__name__)} instead of 8 bit")
    if raw.ndim == 3 and raw.shape[2] == 3:
        grey = cv2.cvtColor(raw, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
    else:
        height, width = shape
        grey = raw.reshape(height, width, -1)[:, :, 0].copy()
    if grey.shape != shape:
        raise ValueError(f"a picture has {grey.shape[1]}x{grey.shape[0]} pixels instead of {shape[1]}x{shape[0]}")
    return grey
