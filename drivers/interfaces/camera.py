"""A camera and its frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces.device import Device

Image = NDArray[np.uint8]
"""Grey image of shape (height, width), 8 bit, row 0 at the top."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture. Times are the start of the exposure on the device's and on the host's clock, in s."""

    image: Image
    frame_id: int
    exposure: float
    device_time: float
    host_time: float
    received: float
    lost_before: int = 0

    @property
    def mid_exposure(self) -> float:
        """Host time of the middle of the exposure."""
        return self.host_time + 0.5 * self.exposure


class FrameStream(Protocol):
    """Frames as they come; knows how many were lost between them (from the gaps in the frame ids)."""

    lost: int

    def next(self, timeout: float) -> Frame:
        """The next frame in order; `DeadlineError` when none comes in time, `DeviceFault` when the camera is lost."""

    def __iter__(self) -> Iterator[Frame]:
        """Frames until the stream is closed."""


class Camera(Device, Protocol):
    """A camera that delivers 8-bit grey frames."""

    shape: tuple[int, int]

    @property
    def time_bound(self) -> float:
        """Largest error in s of the host times of its newest frames, as far as the clocks could be compared."""

    def configure(self, exposure: float, frame_rate: float) -> None:
        """Set exposure in s and frame rate in Hz; refused outside the range or when they clash."""

    def grab(self, timeout: float = 2.0) -> Frame:
        """One frame whose exposure began after the call: never a buffered one."""

    def stream(self) -> AbstractContextManager[FrameStream]:
        """Free-running acquisition for as long as the context is open."""
