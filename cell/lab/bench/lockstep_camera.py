"""A simulated camera in lock step: exposures take the world's time, stamps come from the camera's own clock.

The device's clock has its drift and latency; it is mapped to the host's by the driver's own map, from latches that
were answered somewhere within their round trip.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.clock import Clock
from drivers.clock_map import ClockMap, Latch
from drivers.errors import LimitError
from drivers.interfaces import Frame, Identity, LinkStatistics
from sim_backends.models.camera import CameraModel
from sim_backends.world.hardware import camera_spec
from sim_backends.world.nominal import inverse
from sim_backends.world.world import World

ROUND_TRIP_S = 0.0005
LATCHES = 8


@dataclass(frozen=True, eq=False)
class Shot:
    """Where things truly were half-way through an exposure: poses (4, 4), the carriage's displacement in m."""

    base_from_flange: NDArray[np.float64]
    base_from_surface: NDArray[np.float64]
    carriage: float


class LockstepCamera:
    """The camera "scan" or "target" of `world`; see `drivers.interfaces.Camera` for the promises."""

    def __init__(self, name: str, camera: str, world: World, clock: Clock, wire: np.random.Generator) -> None:
        """`wire` draws when within a round trip the camera answers."""
        self.name = name
        self.statistics = LinkStatistics()
        self._camera = camera
        self._world = world
        self._clock = clock
        self._wire = wire
        self.model = CameraModel(camera_spec(world.scene, camera))
        self._map = ClockMap()
        self.late = 0.0
        """By how many seconds each latch comes later than the camera answers."""
        self.shape = (self.model.spec.height, self.model.spec.width)
        self.shots: dict[int, Shot] = {}
        """The truth at each exposure so far, by the frame's id."""

    def identity(self) -> Identity:
        """The model's own plate."""
        spec = self.model.spec
        return Identity(spec.model, spec.serial, spec.firmware, "in this process")

    @property
    def time_bound(self) -> float:
        """Largest error in s of a frame's host time."""
        return self._map.uncertainty

    def ping(self) -> float:
        """No wire: 0 s."""
        return 0.0

    def configure(self, exposure: float, frame_rate: float) -> None:
        """Set exposure in s and frame rate in Hz; `LimitError` when they clash or the camera cannot."""
        spec = self.model.spec
        if not (
            spec.exposure_min <= exposure <= spec.exposure_max
            and 0 < frame_rate <= spec.frame_rate_max
            and exposure * frame_rate <= 1.0
        ):
            raise LimitError(self.name, f"exposure {exposure:g} s at {frame_rate:g} Hz is not possible")
        self.model.exposure, self.model.frame_rate = exposure, frame_rate

    def grab(self, timeout: float = 2.0) -> Frame:
        """One frame whose exposure begins now."""
        self._compare_clocks()
        while (frame := self._expose(self._clock.now())) is None:
            pass
        return frame

    @contextmanager
    def stream(self) -> Iterator[LockstepStream]:
        """Free-running acquisition for as long as the context is open."""
        self._compare_clocks()
        stream = LockstepStream(self, self._clock.now(), 1.0 / (self.model.frame_rate * self.model.spec.rate))
        try:
            yield stream
        finally:
            stream.close()

    def stop(self) -> None:
        """Nothing runs by itself here."""

    def close(self) -> None:
        """Nothing to let go of."""

    def _compare_clocks(self) -> None:
        now = self._clock.now()
        latches = []
        for k in range(LATCHES):
            before = now + k * (ROUND_TRIP_S + self.late)
            answered = before + float(self._wire.uniform(0.0, ROUND_TRIP_S))
            latches.append(Latch(before, 1e-9 * self.model.spec.device_ns(answered), before + ROUND_TRIP_S + self.late))
        self._map.add(latches)
        self._clock.sleep(LATCHES * (ROUND_TRIP_S + self.late))

    def _expose(self, begin: float) -> Frame | None:
        """The frame whose exposure begins at `begin`, once that is over; None when its picture is lost."""
        exposure, spec = self.model.exposure, self.model.spec
        self._clock.sleep_until(begin + exposure)
        frame_id, lost = self.model.expose()
        if lost:
            return None
        stamp = 1e-9 * spec.device_ns(begin + spec.latency)
        image = self._world.render(self._camera, begin + 0.5 * exposure, exposure)
        self.shots[frame_id] = self._shot(begin + 0.5 * exposure)
        return Frame(image, frame_id, exposure, stamp, self._map.host_time(stamp), self._clock.now())

    def _shot(self, t: float) -> Shot:
        world = self._world
        base_from_surface = inverse(world.world_from_base(t)) @ world.scene.world_from_surface
        return Shot(world.arm.base_from_flange(t), base_from_surface, world.rail.carriage(t))


class LockstepStream:
    """Frames one after another; asking for the next lets the world's time pass up to the end of its exposure."""

    def __init__(self, camera: LockstepCamera, begin: float, period: float) -> None:
        self.lost = 0
        self._camera = camera
        self._next = begin
        self._period = period
        self._open = True

    def next(self, timeout: float) -> Frame:
        """The next frame."""
        while True:
            frame = self._camera._expose(self._next)
            self._next += self._period
            if frame is not None:
                return frame
            self.lost += 1

    def __iter__(self) -> Iterator[Frame]:
        """Frames until the stream is closed."""
        while self._open:
            yield self.next(2.0)

    def close(self) -> None:
        """No more frames."""
        self._open = False
