"""A camera on the network: frame stream protocol, version 1 (`docs/reference/frame-stream.md`), for one client.

In an acquisition one thread exposes on time, another renders what was exposed and sends it. Exposures keep the device's
rate in world time, whatever rendering takes. A picture is asked for once its exposure is over, because only then the
state of the world at its middle is known.
"""

import contextlib
import json
import logging
import math
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sim_backends.clock import WorldClock
from sim_backends.models.camera import CameraSpec, CameraState
from sim_backends.peers.server import TcpServer

MAGIC = b"CFS1"
_PREFIX = struct.Struct(">4sII")
_LONGEST = 64 * 1024


class Rejected(Exception):
    """A request cannot be carried out; the text goes to the client."""


def message(header: dict[str, object], payload: bytes = b"") -> bytes:
    """The bytes of one message."""
    text = json.dumps(header).encode("utf-8")
    return _PREFIX.pack(MAGIC, len(text), len(payload)) + text + payload


def receive(connection: socket.socket) -> dict[str, object] | None:
    """The next request's header; None at the end of the connection. A header that is no JSON object comes back as a
    request that nobody knows. Raises Rejected when the stream is not this protocol at all."""
    prefix = _read(connection, _PREFIX.size)
    if prefix is None:
        return None
    magic, length, payload = _PREFIX.unpack(prefix)
    if magic != MAGIC or length > _LONGEST or payload > _LONGEST:
        raise Rejected(
            f"not a message of frame stream version 1: it must begin with {MAGIC!r}, "
            f"header and payload of a request may have at most {_LONGEST} bytes"
        )
    text = _read(connection, length)
    if text is None or _read(connection, payload) is None:
        return None
    try:
        request = json.loads(text)
    except ValueError as error:
        return {"op": f"a header that is not JSON ({error})"}
    return request if isinstance(request, dict) else {"op": "a header that is not a JSON object"}


def number(request: dict[str, object], key: str, default: float, low: float, high: float, unit: str) -> float:
    """The value of `key`, or `default` when it is not given; Rejected unless a number from `low` to `high`."""
    value = request.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Rejected(f"{key} {value!r} is not a number; allowed {low:g} to {high:g} {unit}")
    if not low <= value <= high:
        raise Rejected(f"{key} {value:g} {unit} is out of range; allowed {low:g} to {high:g} {unit}")
    return float(value)


def _read(connection: socket.socket, count: int) -> bytes | None:
    data = bytearray()
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            return None
        data += part
    return bytes(data)


log = logging.getLogger(__name__)

BACKLOG_S = 12.0
"""World seconds for which exposures may wait for their rendering; a further one is dropped. The world remembers 15."""

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
                if not lost and (not self._exposed or begin - self._exposed[0].begin < BACKLOG_S):
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


_HANDOVER = 0.3
"""Wall seconds that a second client waits for the first one to go."""
_SLOWEST = 0.01
"""Lowest frame rate in Hz."""


class FramePeer(TcpServer):
    """Serves one camera to one client at a time at `address` (`127.0.0.1:port`)."""

    def __init__(self, name: str, clock: WorldClock, render: Render, spec: CameraSpec) -> None:
        """`render` is called in the session's thread, once the exposure that it is to show is over."""
        super().__init__(name, self._serve)
        self.camera = CameraState(spec)
        self._clock = clock
        self._render = render
        self._free = threading.Condition()
        self._session: FrameSession | None = None

    def fault(self, name: str, count: int = 1) -> None:
        """Cause a fault (see `CameraState.fault`); ValueError for another name."""
        self.camera.fault(name, count)

    def clear(self) -> None:
        """Take away all faults."""
        self.camera.clear()

    def _serve(self, connection: socket.socket) -> None:
        session = FrameSession(self.name, self.camera, self._clock, self._render, partial(self._send_frame, connection))
        if not self._take(session):
            self._turn_away(connection)
            return

        def send(header: dict[str, object]) -> None:
            if not self.camera.silent:
                with session.sending:
                    connection.sendall(message(header))

        try:
            session.start()
            while (request := receive(connection)) is not None:
                send({"op": request.get("op"), "id": request.get("id"), **self._answer(session, request)})
        except Rejected as error:
            send({"op": "error", "ok": False, "error": str(error)})
        finally:
            session.end()
            # Whatever is being sent to a client that takes nothing has to come back.
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            with self._free:
                self._session = None
                self._free.notify_all()
            session.join()

    def _take(self, session: FrameSession) -> bool:
        with self._free:
            # A client that has just gone may not have been noticed yet.
            free = self._free.wait_for(lambda: self._session is None, timeout=_HANDOVER)
            if free:
                self._session = session
            return free

    def _turn_away(self, connection: socket.socket) -> None:
        connection.settimeout(2.0)
        request: dict[str, object] = {}
        with contextlib.suppress(OSError, Rejected):
            request = receive(connection) or {}
        error = f"camera {self.camera.spec.serial} is in use by another client: close that one first"
        connection.sendall(message({"op": request.get("op"), "id": request.get("id"), "ok": False, "error": error}))

    def _send_frame(self, connection: socket.socket, exposure: Exposure, image: NDArray[np.uint8]) -> None:
        spec = self.camera.spec
        header = {
            "op": "frame", "frame_id": exposure.frame_id, "device_ns": spec.device_ns(exposure.begin + spec.latency),
            "exposure_s": exposure.duration, "width": spec.width, "height": spec.height,
        }  # fmt: skip
        if not self.camera.silent:
            connection.sendall(message(header, image.tobytes()))

    def _answer(self, session: FrameSession, request: dict[str, object]) -> dict[str, object]:
        operations: dict[str, Callable[[FrameSession, dict[str, object]], dict[str, object]]] = {
            "identify": self._identify, "configure": self._configure, "start": self._start, "stop": self._stop,
            "trigger": self._trigger, "latch": self._latch,
        }  # fmt: skip
        operation = operations.get(str(request.get("op")))
        try:
            if operation is None:
                raise Rejected(f"unknown op {request.get('op')!r}; known: {', '.join(operations)}")
            return {"ok": True, **operation(session, request)}
        except Rejected as error:
            return {"ok": False, "error": str(error)}

    def _identify(self, session: FrameSession, request: dict[str, object]) -> dict[str, object]:
        spec = self.camera.spec
        return {
            "model": spec.model, "serial": spec.serial, "firmware": spec.firmware, "width": spec.width,
            "height": spec.height, "pixel_format": "mono8", "exposure_min_s": spec.exposure_min,
            "exposure_max_s": spec.exposure_max, "frame_rate_max_hz": spec.frame_rate_max,
            **self._latch(session, request),
        }  # fmt: skip

    def _configure(self, session: FrameSession, request: dict[str, object]) -> dict[str, object]:
        if session.running:
            raise Rejected("configure while free-running: stop first")
        camera = self.camera
        limits = (camera.spec.exposure_min, camera.spec.exposure_max)
        exposure = number(request, "exposure_s", camera.exposure, *limits, "s")
        self._set(exposure, self._rate(request, "frame_rate_hz"))
        return {"exposure_s": camera.exposure, "frame_rate_hz": camera.frame_rate}

    def _start(self, session: FrameSession, request: dict[str, object]) -> dict[str, object]:
        if session.running:
            raise Rejected("the camera is free-running already: stop first")
        camera = self.camera
        self._set(camera.exposure, self._rate(request, "frame_rate" if "frame_rate" in request else "frame_rate_hz"))
        first = camera.next_frame_id
        session.run(camera.frame_rate)
        return {"exposure_s": camera.exposure, "frame_rate_hz": camera.frame_rate, "next_frame_id": first}

    def _stop(self, session: FrameSession, request: dict[str, object]) -> dict[str, object]:
        session.halt()
        return {}

    def _trigger(self, session: FrameSession, request: dict[str, object]) -> dict[str, object]:
        if session.running:
            raise Rejected("trigger while free-running: stop first")
        first = self.camera.next_frame_id
        session.trigger()
        return {"next_frame_id": first}

    def _latch(self, session: FrameSession, request: dict[str, object]) -> dict[str, object]:
        return {"device_ns": self.camera.spec.device_ns(self._clock.now())}

    def _rate(self, request: dict[str, object], key: str) -> float:
        return number(request, key, self.camera.frame_rate, _SLOWEST, high=self.camera.spec.frame_rate_max, unit="Hz")

    def _set(self, exposure: float, frame_rate: float) -> None:
        if exposure * frame_rate > 1.0:
            raise Rejected(
                f"exposure {exposure:g} s does not fit into a frame at {frame_rate:g} Hz: "
                f"at most {1.0 / frame_rate:g} s at this rate, or at most {1.0 / exposure:g} Hz at this exposure"
            )
        self.camera.exposure, self.camera.frame_rate = exposure, frame_rate
