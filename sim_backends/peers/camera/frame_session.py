"""A camera's acquisition: one thread exposes on time, another renders what was exposed and sends it.

Exposures keep the device's rate in world time, whatever rendering takes. A picture is asked for once its exposure is
over, because only then the state of the world at its middle is known.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backends.clock import WorldClock
from sim_backends.models.camera import CameraState
from sim_backends.peers.camera.frame_wire import Rejected

log = logging.getLogger(__name__)

BACKLOG = 64
"""Exposures that may wait for their rendering; a further one is dropped."""

Render = Callable[[float, float], NDArray[np.uint8]]
"""(world time of the middle of the exposure, exposure in s) → grey image (height, width)."""


@dataclass(frozen=True)
class Exposure:
    """An exposure: its number, when it began in s of world time, and its duration in s."""

    frame_id: int
    begin: float
    duration: float


Send = Callable[[Exposure, NDArray[np.uint8]], None]
"""Sends a picture, unless the camera is silent; OSError when nobody takes it any more."""


class FrameSession:
    """Acquisition from `start()` to `end()` and `join()`; `sending` is held while a picture is sent."""

    def __init__(self, name: str, camera: CameraState, clock: WorldClock, render: Render, send: Send) -> None:
        self._name = name
        self._camera = camera
        self._clock = clock
        self._render = render
        self._send = send
        self.sending = threading.Lock()
        self._wake = threading.Condition()
        self._ended = threading.Event()
        self._period: float | None = None
        self._next: float | None = None
        self._exposed: deque[Exposure] = deque()
        self._generation = 0
        self._threads = [
            threading.Thread(target=self._expose, name=f"{name}-expose", daemon=True),
            threading.Thread(target=self._deliver, name=f"{name}-render", daemon=True),
        ]

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        """End the acquisition; pictures that were not sent are forgotten."""
        with self._wake:
            self._ended.set()
            self._wake.notify_all()

    def join(self) -> None:
        """Wait for the threads."""
        for thread in self._threads:
            thread.join()

    @property
    def running(self) -> bool:
        """True while free-running."""
        with self._wake:
            return self._period is not None

    def run(self, frame_rate: float) -> None:
        """Free-run from now on, at `frame_rate` Hz of the device's own clock."""
        with self._wake:
            self._period = 1.0 / (frame_rate * self._camera.spec.rate)
            self._next = self._clock.now()
            self._wake.notify_all()

    def trigger(self) -> None:
        """Expose once, now. Raises Rejected while the exposure of the last trigger is going on."""
        with self._wake:
            if self._next is not None:
                raise Rejected("the exposure of the last trigger is not over yet: wait for its frame")
            self._next = self._clock.now()
            self._wake.notify_all()

    def halt(self) -> None:
        """Stop exposing and forget what has not been sent: no frame follows."""
        with self.sending, self._wake:
            self._period = self._next = None
            self._exposed.clear()
            self._generation += 1
            self._wake.notify_all()

    def _expose(self) -> None:
        with self._wake:
            while not self._ended.is_set():
                if self._next is None:
                    self._wake.wait()
                    continue
                begin, duration = self._next, self._camera.exposure
                remaining = begin + duration - self._clock.now()
                if remaining > 0.0:
                    # Whatever happens meanwhile, the next round looks at it afresh.
                    self._wake.wait(self._clock.wall(remaining))
                    continue
                self._next = None if self._period is None else begin + self._period
                frame_id, lost = self._camera.expose()
                if not lost and len(self._exposed) < BACKLOG:
                    self._exposed.append(Exposure(frame_id, begin, duration))
                    self._wake.notify_all()

    def _deliver(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._exposed or self._ended.is_set())
                if self._ended.is_set():
                    return
                exposure, generation = self._exposed.popleft(), self._generation
            try:
                image = self._picture(exposure)
            except Exception:
                log.exception("%s: frame %d is lost: it cannot be rendered", self._name, exposure.frame_id)
                continue
            try:
                self._send_frame(exposure, image, generation)
            except OSError:
                # The client has gone: the thread that reads its requests ends the session.
                return

    def _picture(self, exposure: Exposure) -> NDArray[np.uint8]:
        image = self._render(exposure.begin + 0.5 * exposure.duration, exposure.duration)
        shape = (self._camera.spec.height, self._camera.spec.width)
        if image.shape != shape or image.dtype != np.uint8:
            raise ValueError(f"a picture must be uint8 of shape {shape}, not {image.dtype} of {image.shape}")
        return image

    def _send_frame(self, exposure: Exposure, image: NDArray[np.uint8], generation: int) -> None:
        with self.sending:
            if generation == self._generation:
                self._send(exposure, image)
