"""The queue between the thread that receives frames and the one that uses them.

Times are judged, each on its own and against the frame before it. A stamp that is wrong by a frame puts a whole line of
a sweep elsewhere, and nothing in the picture shows it."""

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

from drivers.clock import Clock, Latch
from drivers.errors import Aborted, DeadlineError, DeviceFault, InterlockError, LimitError, shown
from drivers.interfaces import Frame, LinkStatistics

AHEAD_S = 0.020
"""So much later than the picture came its exposure may end by its stamp: late stamps and clocks that run apart."""
_SAME = 0.02
"""By how much, relative, an exposure may differ from its setting."""
_APART = 0.5
"""Share of the exposure before that two stamps are apart at least."""


class StampCheck:
    """Judges the frames of one acquisition of the camera `name`, in the order in which they come; all of them are
    exposed `exposure` s, where that is known."""

    def __init__(self, name: str, clock: Clock, exposure: float | None) -> None:
        self._name = name
        self._exposure = exposure
        self._ahead = AHEAD_S * max(1.0, clock.rate)
        self._last: Frame | None = None

    def fault(self, frame: Frame) -> DeviceFault | None:
        """The `DeviceFault` camera.exposure or camera.stamp that the frame shows, None for one that can be true. Frames
        with a number below the last one's are late ones, of which nothing is said."""
        last = self._last
        if last is not None and frame.frame_id <= last.frame_id:
            return None
        self._last = frame
        if not (math.isfinite(frame.exposure) and frame.exposure > 0.0):
            return self._made("camera.exposure", f"frame {frame.frame_id} says it was exposed {frame.exposure:g} s")
        wanted = frame.exposure if self._exposure is None else self._exposure
        if abs(frame.exposure - wanted) > _SAME * wanted:
            return self._made(
                "camera.exposure",
                f"frame {frame.frame_id} was exposed {1e3 * frame.exposure:.2f} ms instead of {1e3 * wanted:.2f} ms: "
                "it belongs to another setting",
            )
        if not (math.isfinite(frame.device_time) and math.isfinite(frame.host_time)):
            return self._made("camera.stamp", f"the time stamp of frame {frame.frame_id} is {frame.device_time:g} s")
        early = frame.host_time + frame.exposure - frame.received
        if early > self._ahead:
            return self._made(
                "camera.stamp",
                f"the time stamp of frame {frame.frame_id} lies in the future: its exposure ends {1e3 * early:.1f} ms "
                f"after the picture came (allowed {1e3 * self._ahead:.0f} ms)",
            )
        if last is None:
            return None
        step = frame.device_time - last.device_time
        if step <= 0.0:
            return self._made(
                "camera.stamp",
                f"the time stamp of frame {frame.frame_id} goes back by {-1e3 * step:.1f} ms from that of frame "
                f"{last.frame_id}",
            )
        if step < _APART * last.exposure:
            return self._made(
                "camera.stamp",
                f"the time stamp of frame {frame.frame_id} lies {1e3 * step:.2f} ms after that of frame "
                f"{last.frame_id}, within its exposure of {1e3 * last.exposure:.2f} ms: it belongs to another exposure",
            )
        return None

    def _made(self, code: str, what: str) -> DeviceFault:
        return DeviceFault(
            self._name,
            code,
            what,
            recoverable=False,
            hint="Restart the camera, and see whether something sets its clock meanwhile (time service, another "
            "program). If it comes back, the camera's firmware is at fault.",
        )


QUEUE_BYTES = 64 * 1024 * 1024


def capacity(shape: tuple[int, int]) -> int:
    """How many frames of (height, width) pixels a stream keeps that nobody takes."""
    return max(8, QUEUE_BYTES // (shape[0] * shape[1]))


def check_fits(name: str, exposure: float, frame_rate: float) -> None:
    """`LimitError` when an exposure, s, is longer than a frame at this rate, Hz, lasts."""
    if exposure * frame_rate > 1.0:
        raise LimitError(
            name,
            f"exposure {shown(exposure, 's')} does not fit into a frame at {frame_rate:g} Hz; nothing was sent. "
            f"Choose at most {shown(1.0 / frame_rate, 's')}, or at most {1.0 / exposure:g} Hz",
        )


@contextmanager
def alone(name: str, acquiring: threading.Lock) -> Iterator[None]:
    """Inside this context only its owner acquires frames; `InterlockError` while another one does."""
    if not acquiring.acquire(blocking=False):
        raise InterlockError(name, "frames are being acquired already. Close that stream first")
    try:
        yield
    finally:
        acquiring.release()


_LEAST_LATCHES, _MOST_LATCHES = 8, 32
_GOOD_LATCH_WALL_S = 0.0005


def latched(clock: Clock, latch: Callable[[], Latch | None]) -> list[Latch]:
    """Latches of a camera's clock, as many as it takes to get a short round trip; none where it gives None."""
    latches: list[Latch] = []
    good = _GOOD_LATCH_WALL_S * clock.rate
    while len(latches) < _LEAST_LATCHES or (
        len(latches) < _MOST_LATCHES and min(made.after - made.before for made in latches) > good
    ):
        if (made := latch()) is None:
            return []
        latches.append(made)
    return latches


_SLOW_DEVICE_WALL_S = 2.0


def frame_patience(clock: Clock, timeout: float) -> float:
    """Wall seconds to wait for a frame when the caller allows `timeout` s of the clock.

    A picture is made and carried on the wall's time. On a clock that runs faster the wait is therefore not shortened
    below 2 s of the wall, or below `timeout` itself.
    """
    return max(clock.wall(timeout), min(timeout, _SLOW_DEVICE_WALL_S))


class FrameQueue:
    """Frames in order, at most `capacity`; a frame that finds it full is dropped and counts as lost. One whose times
    cannot be true ends it: see `drivers.camera.frame_queue`.

    `exposure` in s is what the camera was set to, where its frames tell theirs. `check` raises when no frame
    can come any more. `lost` counts the gaps in the frame ids of the frames handed out.
    """

    def __init__(
        self, name: str, clock: Clock, *, capacity: int, longest_gap: float, check: Callable[[], None],
        statistics: LinkStatistics, exposure: float | None = None,
    ) -> None:  # fmt: skip
        self.lost = 0
        self._name = name
        self._clock = clock
        self._capacity = capacity
        self._longest_gap = longest_gap
        self._check = check
        self._statistics = statistics
        self._expected: int | None = None
        self._frames: deque[Frame] = deque()
        self._news = threading.Condition()
        self._closed = False
        self._aborted = False
        self._fresh = partial(StampCheck, name, clock, exposure)
        self._stamps = self._fresh()
        self._untrue: DeviceFault | None = None
        self._untrue_id = 0

    def expect(self, frame_id: int | None) -> None:
        """Tell the id of the first frame, so that the loss of the very first is known; None if unknown."""
        with self._news:
            self._expected = frame_id
            if frame_id is not None and self._untrue_id < frame_id:
                # It was of an acquisition before this one.
                self._untrue, self._stamps = None, self._fresh()

    def put(self, frame: Frame) -> None:
        """Add a frame; called by the receiving thread, never blocks."""
        with self._news:
            ours = self._expected is None or frame.frame_id >= self._expected
            if ours and self._untrue is None:
                self._untrue, self._untrue_id = self._stamps.fault(frame), frame.frame_id
            if self._untrue is not None:
                self._news.notify_all()
                return
            if len(self._frames) >= self._capacity:
                self._statistics.count("frames_dropped_by_host")
                return
            self._frames.append(frame)
            self._news.notify_all()

    def wake(self) -> None:
        """Let waiting callers look again whether frames can still come."""
        with self._news:
            self._news.notify_all()

    def close(self, *, aborted: bool = False) -> None:
        """No more frames: `next` raises `Aborted` from now on, and iteration ends, with `Aborted` if `aborted`."""
        with self._news:
            self._closed, self._aborted = True, aborted
            self._frames.clear()
            self._news.notify_all()

    def next(self, timeout: float) -> Frame:
        """The next frame in order; see `drivers.interfaces.FrameStream`. Raises `Aborted` once it was closed."""
        with self._news:
            self._news.wait_for(self._settled, frame_patience(self._clock, timeout))
            if self._closed:
                raise Aborted(f"{self._name}: the acquisition was stopped")
            if not self._frames and self._untrue is not None:
                raise self._untrue
            if not self._frames:
                raise DeadlineError(
                    self._name,
                    f"no frame within {timeout:.3g} s. Check that exposure and rate are possible and that the "
                    "camera's network is not overloaded",
                )
            frame = self._frames.popleft()
        lost = 0 if self._expected is None else max(0, frame.frame_id - self._expected)
        self._expected = frame.frame_id + 1
        if lost:
            self.lost += lost
            self._statistics.errors["frames_lost"] = self._statistics.errors.get("frames_lost", 0) + lost
        return replace(frame, lost_before=lost)

    def __iter__(self) -> Iterator[Frame]:
        """Frames until the stream is closed; raises like `next` when none comes for 2 s and two frame periods."""
        # Whoever was busy with a frame while it was closed hears of it as well.
        while True:
            try:
                yield self.next(self._longest_gap)
            except Aborted:
                if self._aborted:
                    raise
                return

    def _settled(self) -> bool:
        while self._frames and self._expected is not None and self._frames[0].frame_id < self._expected:
            self._frames.popleft()
            self._statistics.count("stale_frames")
        if self._frames or self._closed or self._untrue is not None:
            return True
        self._check()
        return False
