"""A camera behind the frame stream protocol, version 1 (docs/reference/frame-stream.md), and its TCP connection.

Frames carry the device's time of the start of their exposure, which is mapped to the host's clock through latches
taken before each acquisition. A frame is handed out once and never as an answer to a later question.
"""

import json
import math
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.camera.frame_queue import FrameQueue, alone, capacity, check_fits, latched
from drivers.clock import Clock, ClockMap, Latch
from drivers.errors import (
    ConfigError,
    DeadlineError,
    DeviceFault,
    NotConnectedError,
    check_positive,
    check_range,
    in_the_end,
)
from drivers.interfaces import Frame, Identity, LinkStatistics

_LONGEST_GAP_S = 2.0
_SETTING_TOLERANCE = 0.01
_NUMBERS = ("height", "width", "exposure_min_s", "exposure_max_s", "frame_rate_max_hz")


@dataclass(frozen=True)
class _About:
    """What the camera says of itself: size in pixels, exposure range in s, highest frame rate in Hz."""

    identity: Identity
    shape: tuple[int, int]
    exposure_min: float
    exposure_max: float
    frame_rate_max: float


class StreamCamera:
    """The camera at `address` ("host:port").

    `shape` (height, width), when given, is what the camera has to deliver. Raises `NotConnectedError` when no camera
    answers, `DeviceFault` when another client has it, `ConfigError` when its size is another.
    """

    def __init__(self, name: str, address: str, *, clock: Clock, shape: tuple[int, int] | None = None) -> None:
        self.name = name
        self.statistics = LinkStatistics()
        self._address = address
        self._clock = clock
        self._map = ClockMap()
        self._acquiring = threading.Lock()
        self._queues: tuple[FrameQueue, ...] = ()
        self._frame_rate: float | None = None
        self._exposure: float | None = None
        self._link = FrameLink(name, address, clock, take_frame=self._take, lost=self._wake, statistics=self.statistics)
        try:
            self._about = self._identify()
            self.shape = self._about.shape
            if shape is not None and self.shape != shape:
                raise ConfigError(
                    f"{name}: the camera at {address} delivers {self.shape[1]}x{self.shape[0]} pixels, configured are "
                    f"{shape[1]}x{shape[0]}. Correct the configuration or the address"
                )
            self._compare_clocks()
        except BaseException:
            self._link.close()
            raise

    def identity(self) -> Identity:
        """Ask the camera who it is."""
        return self._identify().identity

    @property
    def time_bound(self) -> float:
        """Largest error in s of a frame's host time: half the shortest latch, and the drift since."""
        return self._map.bound_at(self._clock.now())

    def ping(self) -> float:
        """One latch of the device's clock; returns the round trip in wall seconds."""
        _, before, after = self._link.request("latch")
        return self._clock.wall(after - before)

    def configure(self, exposure: float, frame_rate: float) -> None:
        """Set exposure in s and frame rate in Hz.

        Raises `LimitError` outside the camera's range or when the exposure does not fit into a frame, `InterlockError`
        while frames are being acquired, `DeviceFault` when the camera takes other values.
        """
        about = self._about
        check_range(self.name, "exposure", exposure, low=about.exposure_min, high=about.exposure_max, unit="s")
        check_positive(self.name, "frame rate", frame_rate, about.frame_rate_max, "Hz")
        check_fits(self.name, exposure, frame_rate)
        with self._exclusive():
            set_to = self._link.request("configure", exposure_s=exposure, frame_rate_hz=frame_rate)[0]
        for key, asked in (("exposure_s", exposure), ("frame_rate_hz", frame_rate)):
            if abs(self._number(set_to, "configure", key) - asked) > _SETTING_TOLERANCE * asked:
                raise DeviceFault(
                    self.name,
                    "camera.setting",
                    f"the camera took {key} {set_to[key]} instead of {asked:g}",
                    recoverable=False,
                    hint="Choose a value that the camera supports.",
                )
        self._frame_rate, self._exposure = frame_rate, exposure

    def grab(self, timeout: float = 2.0) -> Frame:
        """One frame whose exposure began after the call: never a buffered one.

        Refused with `InterlockError` while a stream is open. Raises `DeadlineError` when no frame comes in `timeout` s
        (on a fast clock see `frame_patience`), `DeviceFault` when the camera is lost.
        """
        with self._exclusive():
            self._compare_clocks()
            called = self._clock.now()
            with self._queue(4) as frames:
                frames.expect(self._first_id("trigger", self._link.request("trigger")[0]))
                while True:
                    frame = frames.next(timeout)
                    if frame.host_time >= called - self._map.uncertainty:
                        return frame
                    self.statistics.count("stale_frames")

    @contextmanager
    def stream(self) -> Iterator[FrameQueue]:
        """Free-running acquisition for as long as the context is open; one at a time. Frames that nobody takes are kept
        up to 64 MB; later ones are dropped and counted as lost."""
        settings = {} if self._frame_rate is None else {"frame_rate_hz": self._frame_rate}
        with self._exclusive():
            self._compare_clocks()
            with self._queue(capacity(self.shape)) as frames:
                frames.expect(self._first_id("start", self._link.request("start", **settings)[0]))
                with in_the_end(self._end_acquisition):
                    yield frames

    def stop(self) -> None:
        """End every acquisition; whoever waits for a frame gets `Aborted`."""
        for queue in self._queues:
            queue.close(aborted=True)
        self._link.request("stop")

    def close(self) -> None:
        """End acquisition and connection."""
        for queue in self._queues:
            queue.close(aborted=True)
        try:
            self._end_acquisition()
        finally:
            self._link.close()

    def _end_acquisition(self) -> None:
        # A lost camera acquires nothing any more, and the frames' reader has been told.
        if self._link.alive:
            self._link.request("stop")

    def _identify(self) -> _About:
        about = self._link.request("identify")[0]
        try:
            if about["pixel_format"] != "mono8":
                raise ValueError(f"pixel format {about['pixel_format']!r} instead of mono8")
            told = [about[name] for name in _NUMBERS]
            if not all(isinstance(one, int | float) and 0 < one < math.inf for one in told):
                raise ValueError(f"{', '.join(_NUMBERS)} are {told} instead of numbers above 0")
            height, width, low, high, fastest = map(float, told)
            named = Identity(str(about["model"]), str(about["serial"]), str(about["firmware"]), self._address)
            return _About(named, (int(height), int(width)), low, high, fastest)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise self._unusable("identify", repr(error)) from error

    def _number(self, reply: "Header", op: str, key: str) -> float:
        """A finite number of a reply; `DeviceFault` (camera.protocol) where there is none."""
        value = reply.get(key)
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise self._unusable(op, f"{key} is {value!r}")
        return float(value)

    def _first_id(self, op: str, reply: "Header") -> int | None:
        """The id of an acquisition's first frame, where the camera tells it."""
        return None if reply.get("next_frame_id") is None else int(self._number(reply, op, "next_frame_id"))

    def _unusable(self, op: str, why: str) -> DeviceFault:
        return DeviceFault(
            self.name, "camera.protocol", f"the answer to {op!r} cannot be used: {why}", recoverable=False,
            hint="Check that the peer speaks frame stream version 1 with mono8 pictures.",
        )  # fmt: skip

    def _compare_clocks(self) -> None:
        def latch() -> Latch:
            reply, before, after = self._link.request("latch")
            return Latch(before, self._number(reply, "latch", "device_ns") * 1e-9, after)

        self._map.add(latched(self._clock, latch))

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        self._link.check()
        with alone(self.name, self._acquiring):
            yield

    @contextmanager
    def _queue(self, most: int) -> Iterator[FrameQueue]:
        gap = _LONGEST_GAP_S + (2.0 / self._frame_rate if self._frame_rate else 0.0)
        queue = FrameQueue(
            self.name, self._clock, capacity=most, longest_gap=gap, check=self._link.check, statistics=self.statistics,
            exposure=self._exposure,
        )  # fmt: skip
        self._queues = (*self._queues, queue)
        try:
            yield queue
        finally:
            self._queues = tuple(other for other in self._queues if other is not queue)
            queue.close()

    def _take(self, header: "Header", payload: bytearray, received: float) -> None:
        if not self._queues:
            return
        width, height = int(header["width"]), int(header["height"])
        if (height, width) != self.shape or len(payload) != width * height:
            raise ValueError(f"a frame of {width}x{height} pixels came with {len(payload)} bytes")
        device_time = float(header["device_ns"]) * 1e-9
        frame = Frame(
            image=np.frombuffer(payload, np.uint8).reshape(height, width), frame_id=int(header["frame_id"]),
            exposure=float(header["exposure_s"]), device_time=device_time, host_time=self._map.host_time(device_time),
            received=received,
        )  # fmt: skip
        for queue in self._queues:
            queue.put(frame)

    def _wake(self) -> None:
        for queue in self._queues:
            queue.wake()


MAGIC = b"CFS1"
PREFIX = struct.Struct(">4sII")
MAX_HEADER = 64 * 1024
MAX_PAYLOAD = 256 * 1024 * 1024

Header = dict[str, Any]


class StreamError(ValueError):
    """Bytes that are no message of this protocol; the stream cannot be followed any further."""


def encode(header: Header, payload: bytes = b"") -> bytes:
    """The bytes of one message."""
    text = json.dumps(header).encode("utf-8")
    return PREFIX.pack(MAGIC, len(text), len(payload)) + text + payload


def answers(header: Header, awaited: int | None) -> bool:
    """Whether a message answers the request of that number: by its own, or without one as a refusal alone."""
    return header.get("id") == awaited or ("id" not in header and header.get("ok") is False)


def read(receive: Callable[[int], bytearray]) -> tuple[Header, bytearray]:
    """Read one message; `receive(n)` returns exactly n bytes or raises. Raises `StreamError`."""
    magic, header_length, payload_length = PREFIX.unpack(receive(PREFIX.size))
    if magic != MAGIC:
        raise StreamError(f"a message begins with {magic!r} instead of {MAGIC!r}")
    if header_length > MAX_HEADER or payload_length > MAX_PAYLOAD:
        raise StreamError(f"a message announces {header_length} + {payload_length} bytes")
    try:
        header = json.loads(receive(header_length))
    except ValueError as error:
        raise StreamError(f"a header is not JSON: {error}") from error
    if not isinstance(header, dict):
        raise StreamError(f"a header is {type(header).__name__} instead of an object")
    return header, receive(payload_length)


CONNECT_TIMEOUT_S = 2.0
REPLY_TIMEOUT_S = 2.0
"""Wall seconds for a reply; a camera that is busy sending pictures answers between two of them."""


class FrameLink:
    """A connection to the camera at `address` ("host:port").

    `take_frame(header, payload, received)` and `lost()` are called in the reader's thread. Raises `NotConnectedError`
    when nobody answers there, `ConfigError` when the address is none.
    """

    def __init__(
        self, name: str, address: str, clock: Clock, *, take_frame: Callable[[Header, bytearray, float], None],
        lost: Callable[[], None], statistics: LinkStatistics,
    ) -> None:  # fmt: skip
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise ConfigError(f"{name}: address {address!r} is not HOST:PORT, like 192.168.1.20:5006. Correct it")
        self._name = name
        self._address = address
        self._clock = clock
        self._take_frame = take_frame
        self._lost = lost
        self._statistics = statistics
        self._requesting = threading.Lock()
        self._answered = threading.Condition()
        self._awaited = 0
        self._answer: tuple[Header, float] | None = None
        self._closed = False
        self._failure: str | None = None
        try:
            self._socket = socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT_S)
        except OSError as error:
            raise NotConnectedError(
                name, f"no camera answers at {address}: {error}. Check the address and that the camera is on"
            ) from error
        self._socket.settimeout(None)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._reader = threading.Thread(target=self._read, name=f"{name} reader", daemon=True)
        self._reader.start()

    @property
    def alive(self) -> bool:
        """True while the connection stands."""
        return not self._closed and self._failure is None

    def check(self) -> None:
        """Raise `NotConnectedError` after `close`, `DeviceFault` (camera.lost) when the connection has ended."""
        if self._closed:
            raise NotConnectedError(self._name, "the camera was closed. Open it again")
        if self._failure is not None:
            raise DeviceFault(
                self._name,
                "camera.lost",
                f"camera lost: {self._failure}",
                recoverable=False,
                hint=f"Check power and network of the camera at {self._address}, then open the cell again.",
            )

    def request(self, op: str, **fields: object) -> tuple[Header, float, float]:
        """Ask the camera; returns the reply and the host times of sending and of its arrival. Raises `DeviceFault` when
        the camera refuses (camera.refused) or is lost, `DeadlineError` when it is silent."""
        with self._requesting:
            self.check()
            with self._answered:
                self._awaited += 1
                self._answer = None
            message = encode({"op": op, "id": self._awaited, **fields})
            before = self._clock.now()
            try:
                self._socket.sendall(message)
            except OSError as error:
                self._fail(f"sending failed: {error}")
            with self._answered:
                self._answered.wait_for(lambda: self._last_answer() is not None or not self.alive, REPLY_TIMEOUT_S)
                answer = self._last_answer()
        if answer is None:
            self.check()
            self._statistics.count("timeouts")
            raise DeadlineError(
                self._name, f"no answer to {op!r} within {REPLY_TIMEOUT_S:.0f} s. Check the camera at {self._address}"
            )
        header, after = answer
        if header.get("ok") is not True:
            raise DeviceFault(
                self._name,
                "camera.refused",
                f"the camera refused {op!r}: {header.get('error', 'no reason given')}",
                recoverable=True,
                hint="Correct what it names.",
            )
        self._statistics.add_round_trip(self._clock.wall(after - before))
        return header, before, after

    def close(self) -> None:
        """End the connection and the reader; idempotent."""
        self._closed = True
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        if self._reader is not threading.current_thread():
            self._reader.join(2.0)
        self._socket.close()

    def _last_answer(self) -> tuple[Header, float] | None:
        return self._answer

    def _read(self) -> None:
        try:
            while not self._closed:
                header, payload = read(self._receive)
                received = self._clock.now()
                if header.get("op") == "frame":
                    self._take_frame(header, payload, received)
                else:
                    with self._answered:
                        if answers(header, self._awaited):
                            self._answer = (header, received)
                            self._answered.notify_all()
                        else:
                            self._statistics.count("late_replies")
        except (OSError, StreamError, KeyError, ValueError, TypeError) as error:
            self._fail(str(error) or repr(error))
        except Exception as error:
            # Without its reader the link is lost, whatever ended it.
            self._fail(repr(error))

    def _receive(self, count: int) -> bytearray:
        data = bytearray(count)
        view = memoryview(data)
        while view:
            got = self._socket.recv_into(view)
            if got == 0:
                raise ConnectionError("the connection was ended by the camera")
            view = view[got:]
        return data

    def _fail(self, reason: str) -> None:
        with self._answered:
            if self.alive:
                self._failure = reason
                self._statistics.count("link_lost")
            self._answered.notify_all()
        self._lost()
