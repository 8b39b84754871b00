"""A simulated camera beside real devices: a picture that its world could not make is asked for again.

Readings of a real device leave gaps now and then. A single picture into such a gap is not made; the next one is,
because whoever takes single pictures waits until everything rests. A stream's lost frames are counted as any others.
"""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager

from drivers.errors import DeadlineError
from drivers.interfaces import Camera, Frame, FrameStream, Identity

TRIES = 3
"""How often at most a picture is asked for, each time with the whole time that it may take."""

log = logging.getLogger(__name__)


class FollowedCamera:
    """A camera, `bare`, whose world follows real devices; see `drivers.interfaces.Camera`."""

    def __init__(self, bare: Camera) -> None:
        self.bare = bare
        self.name, self.shape, self.statistics = bare.name, bare.shape, bare.statistics

    def identity(self) -> Identity:
        """See `Device.identity`."""
        return self.bare.identity()

    def ping(self) -> float:
        """See `Device.ping`."""
        return self.bare.ping()

    @property
    def time_bound(self) -> float:
        """See `Camera.time_bound`."""
        return self.bare.time_bound

    def configure(self, exposure: float, frame_rate: float) -> None:
        """See `Camera.configure`."""
        self.bare.configure(exposure, frame_rate)

    def grab(self, timeout: float = 2.0) -> Frame:
        """See `Camera.grab`; tried up to `TRIES` times, then the last try's `DeadlineError`."""
        for k in range(1, TRIES):
            try:
                return self.bare.grab(timeout)
            except DeadlineError as error:
                self.statistics.count("picture asked for again")
                log.info("%s; asked for again, %d of %d", error, k + 1, TRIES)
        return self.bare.grab(timeout)

    def stream(self) -> AbstractContextManager[FrameStream]:
        """See `Camera.stream`."""
        return self.bare.stream()

    def stop(self) -> None:
        """See `Device.stop`."""
        self.bare.stop()

    def close(self) -> None:
        """See `Device.close`."""
        self.bare.close()
