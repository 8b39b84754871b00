"""A USB or built-in camera under Linux (V4L2, UVC) through OpenCV.

Such a camera does not say when an exposure began. The kernel stamps a picture with the computer's own clock: at the
start of the exposure, or as late as when its first bytes came, after the exposure and up to a frame later. Its times
are known to half of that: enough for photographs and not for a sweep, which is then refused. Never run on a camera."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np

from drivers.camera.frame_queue import FrameQueue, alone, capacity, check_fits
from drivers.clock import Clock
from drivers.errors import (
    CellError,
    ConfigError,
    DeviceFault,
    InterlockError,
    NotConnectedError,
    check_positive,
    check_range,
)
from drivers.interfaces import Frame, Identity, Image, LinkStatistics


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


FORMATS = ("GREY", "YUYV", "MJPG")
_EXPOSURE_UNIT_S = 1e-4
_EXPOSURES_S = (1e-4, 1.0)
_HIGHEST_HZ = 500.0
_MANUAL = 1
_TOLERANCE = 0.02
_OLDEST_S = 10.0


class V4l2Camera:
    """The camera at the device file `path`, set to (height, width) `shape` in the pixel format `fourcc`. Raises
    `NotConnectedError` when there is none or another program has it, `ConfigError` when its size is another."""

    def __init__(
        self, name: str, path: str, *, clock: Clock, shape: tuple[int, int], fourcc: str = "YUYV",
        gain: float | None = None, look: bool = False,
    ) -> None:  # fmt: skip
        self.name = name
        self.shape = shape
        self.statistics = LinkStatistics()
        self._path = path
        self._clock = clock
        self._look = look
        self._timing = ExposureTiming(0.01, 10.0)
        self._acquiring = threading.Lock()
        self._queue: FrameQueue | None = None
        self._ended = threading.Event()
        self._failure: CellError | None = None
        self._count = 0
        self._stamp: float | None = None
        self._capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise NotConnectedError(
                name,
                f"{path} is no camera that can be opened. Check the cable and `v4l2-ctl --list-devices`, that this "
                f"user is in the group video, and that no other program uses it (`fuser -v {path}`)",
            )
        if not look:
            try:
                self._set_image(fourcc, gain)
            except CellError:
                self._capture.release()
                raise

    def identity(self) -> Identity:
        """The device file; OpenCV tells neither model nor serial number."""
        self._require()
        return Identity(f"V4L2 camera ({self._capture.getBackendName()})", "", "", self._path)

    @property
    def time_bound(self) -> float:
        """Largest error in s of a frame's host time: half of what its stamp leaves open."""
        return 0.5 * self._timing.open_s

    def ping(self) -> float:
        """Read one setting; returns the wall seconds it took."""
        self._require()
        before = self._clock.now()
        self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)
        seconds = self._clock.wall(self._clock.now() - before)
        self.statistics.add_round_trip(seconds)
        return seconds

    def configure(self, exposure: float, frame_rate: float) -> None:
        """Set exposure in s (in steps of 0.1 ms) and frame rate in Hz, and read them back.

        Raises `LimitError` outside UVC's range or when the exposure does not fit into a frame, `InterlockError` while
        frames are being acquired, `DeviceFault` (camera.setting) when the camera takes other values.
        """
        check_range(self.name, "exposure", exposure, *_EXPOSURES_S, "s")
        check_positive(self.name, "frame rate", frame_rate, _HIGHEST_HZ, "Hz")
        check_fits(self.name, exposure, frame_rate)
        with self._exclusive():
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
            self._set(cv2.CAP_PROP_EXPOSURE, "exposure", round(exposure / _EXPOSURE_UNIT_S), "x 0.1 ms")
            self._set(cv2.CAP_PROP_FPS, "frame rate", frame_rate, "Hz")
            self._timing = ExposureTiming(exposure, frame_rate)

    def grab(self, timeout: float = 2.0) -> Frame:
        """One frame whose exposure began after the call, as far as its stamp can tell: never a buffered one."""
        with self._exclusive():
            called = self._clock.now()
            with self._acquire(8) as frames:
                while True:
                    frame = frames.next(timeout)
                    if frame.host_time - self.time_bound >= called:
                        return frame
                    self.statistics.count("stale_frames")

    @contextmanager
    def stream(self) -> Iterator[FrameQueue]:
        """Frames as they come; lost ones are known from gaps between the stamps."""
        with self._exclusive(), self._acquire(capacity(self.shape)) as frames:
            yield frames

    def stop(self) -> None:
        """End every acquisition; whoever waits for a frame gets `Aborted`."""
        self._ended.set()
        if (queue := self._queue) is not None:
            queue.close(aborted=True)

    def close(self) -> None:
        """End acquisition and connection; idempotent."""
        self.stop()
        if self._acquiring.acquire(timeout=2.0):
            self._acquiring.release()
        self._capture.release()

    def _require(self) -> None:
        if not self._capture.isOpened():
            raise NotConnectedError(self.name, f"{self._path} was closed. Open it again")

    def _set_image(self, fourcc: str, gain: float | None) -> None:
        capture = self._capture
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc))
        # The first plane of YUYV is the grey itself; what is compressed has to be decoded.
        capture.set(cv2.CAP_PROP_CONVERT_RGB, float(fourcc == "MJPG"))
        height, width = self.shape
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        taken = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if taken != (width, height):
            raise ConfigError(
                f"{self.name}: the camera at {self._path} gives {taken[0]}x{taken[1]} pixels, configured are "
                f"{width}x{height}. `v4l2-ctl -d {self._path} --list-formats-ext` shows what it has"
            )
        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        if (named := code.to_bytes(4, "little").decode("ascii", "replace")) != fourcc:
            raise DeviceFault(
                self.name,
                "camera.setting",
                f"the camera took pixel format {named!r} instead of {fourcc!r}",
                recoverable=False,
                hint=f"Choose one that it has ({', '.join(FORMATS)} are known here).",
            )
        if gain is not None:
            self._set(cv2.CAP_PROP_GAIN, "gain", gain, "")

    def _set(self, setting: int, what: str, value: float, unit: str) -> None:
        accepted = self._capture.set(setting, value)
        taken = self._capture.get(setting)
        if not accepted or abs(taken - value) > _TOLERANCE * abs(value):
            raise DeviceFault(
                self.name,
                "camera.setting",
                f"the camera took {what} {taken:g} {unit} instead of {value:g} {unit}".replace("  ", " "),
                recoverable=False,
                hint=f"Choose a value that it has: `v4l2-ctl -d {self._path} --list-ctrls` shows its ranges.",
            )

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        if self._look:
            raise InterlockError(self.name, "the camera is only looked at. Open it to use it")
        self._require()
        with alone(self.name, self._acquiring):
            yield

    @contextmanager
    def _acquire(self, most: int) -> Iterator[FrameQueue]:
        self._ended.clear()
        self._failure = None
        longest = 2.0 + 2.0 / self._timing.frame_rate
        queue = FrameQueue(
            self.name, self._clock, capacity=most, longest_gap=longest, check=self._check, statistics=self.statistics
        )
        self._queue = queue
        reader = threading.Thread(target=self._read, args=(queue,), name=f"{self.name} pictures", daemon=True)
        reader.start()
        try:
            yield queue
        finally:
            self._ended.set()
            reader.join()
            self._queue = None
            queue.close()

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _read(self, queue: FrameQueue) -> None:
        begun = time.monotonic()
        try:
            while not self._ended.is_set():
                there, raw = self._capture.read()
                stamp = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC)
                if not there:
                    raise self._fault(
                        "camera.lost", "no picture comes any more", "Check the cable, then open it again."
                    )
                if stamp >= begun:
                    queue.put(self._frame(raw, stamp))
        except CellError as error:
            self._failure = error
        except Exception as error:
            self._failure = self._fault("camera.lost", repr(error), "Check the camera, then open it again.")
        queue.wake()

    def _frame(self, raw: object, stamp: float) -> Frame:
        age = time.monotonic() - stamp
        if not 0.0 <= age < _OLDEST_S:
            raise self._fault(
                "camera.clock",
                f"a picture's stamp is {age:.3g} s old (allowed: 0 to {_OLDEST_S:g} s)",
                "The kernel has to stamp by CLOCK_MONOTONIC: load uvcvideo with clock=CLOCK_MONOTONIC.",
            )
        received = self._clock.now()
        if self._stamp is None:
            self._count += 1
        else:
            self._count += max(1, round((stamp - self._stamp) * self._timing.frame_rate))
        self._stamp = stamp
        host = received - age * self._clock.rate - self.time_bound
        return Frame(to_grey(raw, self.shape), self._count, self._timing.exposure, stamp, host, received=received)

    def _fault(self, code: str, what: str, hint: str) -> DeviceFault:
        return DeviceFault(self.name, code, f"{what} from {self._path}", recoverable=False, hint=hint)
