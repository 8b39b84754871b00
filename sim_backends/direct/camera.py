"""A camera in this process: exposures take the world's time, stamps come from the camera's own clock.

That clock has drift and latency. It is compared with the host's by latches, answered somewhere within their round trip.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.clock import Clock, ClockMap, Latch
from drivers.errors import Aborted, DeadlineError, InterlockError, LimitError
from drivers.interfaces import Frame, Identity
from sim_backends.direct.switches import DirectDevice
from sim_backends.models.camera import CameraState
from sim_backends.world.drawing import inverse
from sim_backends.world.world import World, camera_spec

ROUND_TRIP_S = 0.0005
LATCHES = 8
ANSWER_S = 0.5
"""A camera that says nothing for this long when it is asked something does not answer."""
LONGEST_GAP_S = 2.0


@dataclass(frozen=True, eq=False)
class Shot:
    """Where things truly were half-way through an exposure: poses (4, 4), the carriage's displacement in m."""

    base_from_flange: NDArray[np.float64]
    base_from_surface: NDArray[np.float64]
    carriage: float


class DirectCamera(DirectDevice):
    """The camera "scan" or "target" of `world`; see `drivers.interfaces.Camera` for the promises."""

    def __init__(self, name: str, camera: str, world: World, clock: Clock, *, wire: np.random.Generator) -> None:
        """`wire` draws when within a round trip the camera answers."""
        super().__init__(name)
        self.model = CameraState(camera_spec(world.scene, camera))
        self.clock = clock
        self.late = 0.0
        """By how many seconds each latch comes later than the camera answers."""
        self.lingers = 0.0
        """How many seconds a stream takes to end."""
        self.shape = (self.model.spec.height, self.model.spec.width)
        self.shots: dict[int, Shot] = {}
        """The truth at each exposure so far, by the frame's id."""
        self._camera = camera
        self._world = world
        self._wire = wire
        self._map = ClockMap()
        self._streams: list[DirectStream] = []

    def identity(self) -> Identity:
        """The model's own plate."""
        spec = self.model.spec
        return Identity(spec.model, spec.serial, spec.firmware, "in this process")

    @property
    def time_bound(self) -> float:
        """Largest error in s of a frame's host time."""
        return self._map.uncertainty

    def configure(self, exposure: float, frame_rate: float) -> None:
        """Set exposure in s and frame rate in Hz; `LimitError` when they clash or the camera cannot."""
        spec = self.model.spec
        if not (
            spec.exposure_min <= exposure <= spec.exposure_max
            and 0 < frame_rate <= spec.frame_rate_max
            and exposure * frame_rate <= 1.0
        ):
            raise LimitError(
                self.name,
                f"exposure {1e3 * exposure:g} ms at {frame_rate:g} Hz is not possible; allowed are "
                f"{1e3 * spec.exposure_min:g} ms to {1e3 * spec.exposure_max:g} ms, up to {spec.frame_rate_max:g} Hz, "
                "and no exposure longer than a frame",
            )
        self._require_free()
        self._require_answer()
        self.model.exposure, self.model.frame_rate = exposure, frame_rate

    def grab(self, timeout: float = 2.0) -> Frame:
        """One frame whose exposure begins now; `DeadlineError` when none comes in `timeout` s."""
        self._require_free()
        self._compare_clocks()
        deadline = self.clock.now() + timeout
        while (frame := self.expose(self.clock.now(), deadline)) is None:
            pass
        return frame

    @contextmanager
    def stream(self) -> "Iterator[DirectStream]":
        """Free-running acquisition for as long as the context is open."""
        self._require_free()
        self._compare_clocks()
        stream = DirectStream(self, self.clock.now(), 1.0 / (self.model.frame_rate * self.model.spec.rate))
        self._streams.append(stream)
        try:
            yield stream
        finally:
            self.clock.sleep(self.lingers)
            self._streams.remove(stream)
            stream.close()

    def stop(self) -> None:
        """End every acquisition; whoever waits for a frame gets `Aborted`."""
        for stream in self._streams:
            stream.close(aborted=True)

    def close(self) -> None:
        """End every acquisition."""
        self.stop()

    def expose(self, begin: float, deadline: float) -> Frame | None:
        """The frame whose exposure begins at `begin`, once that is over; None when its picture is lost. `DeadlineError`
        when none can come by `deadline`."""
        exposure, spec = self.model.exposure, self.model.spec
        if self.model.silent or begin + exposure > deadline:
            self.clock.sleep_until(deadline)
            raise DeadlineError(
                self.name,
                "no frame came in time. Check that exposure and rate are possible and that the camera's network is "
                "not overloaded",
            )
        self.clock.sleep_until(begin + exposure)
        frame_id, lost = self.model.expose()
        if lost:
            return None
        stamp = 1e-9 * spec.device_ns(begin + spec.latency)
        image = self._world.render(self._camera, begin + 0.5 * exposure, exposure)
        t = begin + 0.5 * exposure
        world = self._world
        base_from_surface = inverse(world.world_from_base(t)) @ world.scene.world_from_surface
        self.shots[frame_id] = Shot(world.arm.base_from_flange(t), base_from_surface, world.rail.carriage(t))
        return Frame(image, frame_id, exposure, stamp, host_time=self._map.host_time(stamp), received=self.clock.now())

    def _compare_clocks(self) -> None:
        self._require_answer()
        now = self.clock.now()
        latches = []
        for k in range(LATCHES):
            before = now + k * (ROUND_TRIP_S + self.late)
            answered = before + float(self._wire.uniform(0.0, ROUND_TRIP_S))
            device = 1e-9 * self.model.spec.device_ns(answered)
            latches.append(Latch(before, device, before + ROUND_TRIP_S + self.late))
        self._map.add(latches)
        self.clock.sleep(LATCHES * (ROUND_TRIP_S + self.late))

    def _require_free(self) -> None:
        if self._streams:
            raise InterlockError(self.name, "frames are being acquired already. Close that stream first")

    def _require_answer(self) -> None:
        if self.model.silent:
            self.clock.sleep(ANSWER_S)
            raise DeadlineError(self.name, f"no answer within {ANSWER_S:g} s. Check that it has power and its network")


class DirectStream:
    """Frames one after another; asking for the next lets the world's time pass up to the end of its exposure."""

    def __init__(self, camera: DirectCamera, begin: float, period: float) -> None:
        self.lost = 0
        self._camera = camera
        self._next = begin
        self._period = period
        self._closed = threading.Event()
        self._aborted = False

    def next(self, timeout: float) -> Frame:
        """The next frame in order; see `drivers.interfaces.FrameStream`. Raises `Aborted` once it was closed."""
        deadline = max(self._camera.clock.now(), self._next) + timeout
        before = self.lost
        while not self._closed.is_set():
            frame = self._camera.expose(self._next, deadline)
            self._next += self._period
            if self._closed.is_set():
                break
            if frame is not None:
                return replace(frame, lost_before=self.lost - before)
            self.lost += 1
        raise Aborted(f"{self._camera.name}: the acquisition was stopped")

    def __iter__(self) -> Iterator[Frame]:
        """Frames until the stream is closed, with `Aborted` if it was stopped, also while a frame was looked at."""
        while True:
            try:
                yield self.next(LONGEST_GAP_S + 2.0 * self._period)
            except Aborted:
                if self._aborted:
                    raise
                return

    def close(self, *, aborted: bool = False) -> None:
        """No more frames; `aborted` when it was stopped before its end."""
        self._aborted = aborted
        self._closed.set()
