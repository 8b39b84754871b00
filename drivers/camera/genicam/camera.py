"""A camera on GigE Vision or USB3 Vision.

Its time stamps are mapped to the host's clock through latches of its clock before each acquisition; where it has no
latch, through triggered pictures, which began after the trigger was sent and ended before they came. Each triggered
picture is also held against that interval, every other one against its end: a camera whose stamps do not lie in it is
refused. Nothing of this has run on a camera of any maker yet; docs/how-to/cameras.md says with what it was tested.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.camera.frame_queue import FrameQueue
from drivers.camera.genicam.acquisition import AcquiredPicture, Acquisition
from drivers.camera.genicam.connection import GenicamSetup, Wish, connect, set_timing, set_trigger
from drivers.camera.genicam.device import GenicamDevice, Place, StampClock
from drivers.clock import Clock
from drivers.errors import CellError, DeviceFault, InterlockError, NotConnectedError, in_the_end
from drivers.interfaces import Frame, Identity, LinkStatistics

_QUEUE_BYTES = 64 * 1024 * 1024
_LONGEST_GAP_S = 2.0
_TRIES = 3
_PACKETS_LOST = "camera.packets_lost"


class GenicamCamera:
    """The camera at `place`; `look`: only looked at, so nothing is set and no picture can be taken.

    Raises `NotConnectedError` when the library or the camera is missing, `DeviceFault` when another application holds
    the camera or it refuses a setting, `LimitError` when a setting is outside its range.
    """

    def __init__(self, name: str, place: Place, setup: GenicamSetup, *, clock: Clock, look: bool = False) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self.shape = (setup.region.height, setup.region.width)
        self._place = place
        self._setup = setup
        self._clock = clock
        self._look = look
        self._acquiring = threading.Lock()
        self._queue: FrameQueue | None = None
        self._acquisition: Acquisition | None = None
        self._wish: Wish | None = None
        self._serial: str | None = None
        self._count = 0
        self._closed = False
        self._connect()

    def identity(self) -> Identity:
        """Ask the camera who it is."""
        return self._ready().identity()

    @property
    def time_bound(self) -> float:
        """Largest error in s of a frame's host time; unlimited while nothing tells of the camera's clock."""
        return self._stamps.bound

    def ping(self) -> float:
        """One register read; returns the round trip in wall seconds."""
        device = self._ready()
        before = self._clock.now()
        device.ping()
        seconds = self._clock.wall(self._clock.now() - before)
        self.statistics.add_round_trip(seconds)
        return seconds

    def configure(self, exposure: float, frame_rate: float) -> None:
        """Set exposure in s and frame rate in Hz.

        Raises `LimitError` outside the camera's range or when the exposure does not fit into a frame, `InterlockError`
        while frames are being acquired, `DeviceFault` when the camera takes other values.
        """
        with self._exclusive() as device:
            self._wish = set_timing(device, Wish(exposure, frame_rate), paced=self._setup.trigger.paced)

    def grab(self, timeout: float = 2.0) -> Frame:
        """One frame whose exposure began after the call: never a buffered one.

        Refused with `InterlockError` while a stream is open. Raises `DeadlineError` when no frame comes in `timeout` s,
        `DeviceFault` when the camera is lost (camera.lost), packets are missing of three pictures in turn
        (camera.packets_lost) or its time stamp is none of this exposure (camera.clock).
        """
        with self._exclusive() as device:
            self._stamps.compare(device)
            triggered = set_trigger(device, self._setup.trigger, self._timing(device), photograph=True)
            tried = 0
            while True:
                try:
                    return self._photograph(device, timeout, triggered=triggered)
                except DeviceFault as fault:
                    tried += 1
                    if fault.code != _PACKETS_LOST or tried == _TRIES:
                        raise

    @contextmanager
    def stream(self) -> Iterator[FrameQueue]:
        """Frames at the configured rate, or at the pulses of the trigger's line, while the context is open.

        One at a time. Frames that nobody takes are kept up to 64 MB; later ones are dropped and counted as lost.
        """
        height, width = self.shape
        with self._exclusive() as device:
            self._stamps.compare(device)
            set_trigger(device, self._setup.trigger, self._timing(device), photograph=False)
            with self._acquire(device, capacity=max(8, _QUEUE_BYTES // (height * width)), whole=False) as frames:
                yield frames

    def stop(self) -> None:
        """End every acquisition; whoever waits for a frame gets `Aborted`."""
        if (queue := self._queue) is not None:
            queue.close(aborted=True)
        if (acquisition := self._acquisition) is not None:
            acquisition.stop()

    def close(self) -> None:
        """End acquisition and connection; idempotent."""
        self._closed = True
        try:
            self.stop()
        finally:
            if self._device.open:
                self._device.close()

    # --- connection ---

    def _connect(self) -> None:
        device, self._serial = connect(
            self.name, self._place, self._setup, self._wish, look=self._look, serial=self._serial
        )
        self._device, self._stamps = device, StampClock(self.name, self._clock)
        if not self._look:
            try:
                self._stamps.compare(device)
            except CellError:
                device.close()
                raise

    def _ready(self) -> GenicamDevice:
        """The camera, connected anew if it was lost."""
        if self._closed:
            raise NotConnectedError(self.name, "the camera was closed. Open it again")
        if not self._device.open or not self._device.held:
            if self._acquisition is not None:
                raise self._device.lost("its link is down while pictures are being taken")
            self._device.abandon()
            self._connect()
            self.statistics.count("link_lost")
        return self._device

    # --- acquisition ---

    @contextmanager
    def _exclusive(self) -> Iterator[GenicamDevice]:
        if self._look:
            raise InterlockError(self.name, "the camera is only looked at. Open it to use it")
        if not self._acquiring.acquire(blocking=False):
            raise InterlockError(self.name, "frames are being acquired already. Close that stream first")
        try:
            try:
                yield self._ready()
            except DeviceFault as fault:
                if fault.code == "camera.lost":
                    self._device.abandon()
                raise
        finally:
            self._acquiring.release()

    @contextmanager
    def _acquire(self, device: GenicamDevice, *, capacity: int, whole: bool) -> Iterator[FrameQueue]:
        """Frames while the camera acquires; `whole`: an incomplete picture is a fault, not only a loss."""

        wrong: list[DeviceFault] = []

        def check() -> None:
            if acquisition.failure is not None:
                raise acquisition.failure
            if wrong:
                raise wrong[0]
            if whole and acquisition.incomplete:
                raise self._packets_lost()

        queue = FrameQueue(
            self.name,
            self._clock,
            capacity=capacity,
            longest_gap=_LONGEST_GAP_S + (2.0 / self._wish.frame_rate if self._wish else 0.0),
            check=check,
            statistics=self.statistics,
        )
        base = self._count

        def take(picture: AcquiredPicture) -> None:
            self._count = base + picture.count
            frame = self._frame(picture, self._count)
            if (fault := self._stamps.impossible(frame)) is not None:
                wrong.append(fault)
                queue.wake()
            else:
                queue.put(frame)

        network = self._setup.network if self._place.control else None
        buffers = max(4, min(64, _QUEUE_BYTES // max(1, self.shape[0] * self.shape[1])))
        acquisition = Acquisition(device, network, buffers, take=take, failed=queue.wake, statistics=self.statistics)
        self._queue, self._acquisition = queue, acquisition
        try:
            with in_the_end(acquisition.stop):
                acquisition.start()
                yield queue
        finally:
            self._queue = self._acquisition = None
            queue.close()

    def _photograph(self, device: GenicamDevice, timeout: float, *, triggered: bool) -> Frame:
        with self._acquire(device, capacity=4, whole=True) as frames:
            called = self._clock.now()
            if triggered:
                device.call("software_trigger")
            while True:
                frame = frames.next(timeout)
                if triggered:
                    return self._stamps.judged(frame, called)
                if frame.host_time >= called - self._stamps.slack:
                    return frame
                self.statistics.count("stale_frames")

    def _frame(self, picture: AcquiredPicture, count: int) -> Frame:
        received = self._clock.now()
        if picture.image.shape != self.shape:
            height, width = picture.image.shape
            raise ValueError(f"a picture has {width}x{height} pixels, set were {self.shape[1]}x{self.shape[0]}")
        assert self._wish is not None
        device_time = picture.device_ns * 1e-9 if self._device.stamps else 0.0
        host_time = self._stamps.host_time(device_time, latest=received - self._wish.exposure)
        return Frame(picture.image, count, self._wish.exposure, device_time, host_time=host_time, received=received)

    def _timing(self, device: GenicamDevice) -> Wish:
        """What is set; before the first `configure` whatever the camera has."""
        if self._wish is None:
            self._wish = set_timing(device, None, paced=self._setup.trigger.paced)
        return self._wish

    def _packets_lost(self) -> DeviceFault:
        return DeviceFault(
            self.name,
            _PACKETS_LOST,
            "packets of a picture were lost on the way and did not come again",
            recoverable=True,
            hint="Use packets that the network carries (packet_size, jumbo frames), pause between them (packet_delay), "
            "keep resend on, and give the camera a network port of its own.",
        )
