"""A camera on the network: frame stream protocol, version 1 (`docs/frame-stream.md`).

Exposures happen at the device's rate in world time, whatever rendering takes: a picture shows the world at the middle
of its exposure and is sent when it has been rendered. The device has its own clock, with its own epoch and drift.
"""

from __future__ import annotations

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_backends.clock import WorldClock
from sim_backends.peers.server import TcpServer

log = logging.getLogger(__name__)

FAULTS = ("camera.frame_loss", "camera.silent")
MAGIC = b"CFS1"
BACKLOG = 64
"""Exposures that may wait for their rendering; a further one is dropped."""
_PREFIX = struct.Struct(">4sII")
_MAX_HEADER = 64 * 1024
_HANDOVER = 0.3
"""Wall seconds that a second client waits for the first one to go."""

Render = Callable[[float, float], NDArray[np.uint8]]
"""(world time of the middle of the exposure, exposure in s) → grey image (height, width)."""


@dataclass(frozen=True)
class CameraSpec:
    """What the camera is. The device clock reads `epoch` s at world time 0 and runs `drift_ppm` fast.

    `latency` (s) is by how much the time stamps are later than the exposures really began.
    """

    model: str
    serial: str
    width: int
    height: int
    frame_rate_max: float
    firmware: str = "1.0"
    exposure_min: float = 20e-6
    exposure_max: float = 1.0
    epoch: float = 1000.0
    drift_ppm: float = 0.0
    latency: float = 0.0

    def device_time(self, t: float) -> float:
        """Reading of the device clock in s at world time `t`."""
        return self.epoch + t * (1.0 + 1e-6 * self.drift_ppm)


class Rejected(Exception):
    """A request cannot be carried out; the text goes to the client."""


class FramePeer:
    """Serves one camera to one client at a time at `address` (`127.0.0.1:port`)."""

    def __init__(self, name: str, clock: WorldClock, render: Render, spec: CameraSpec) -> None:
        self.name = name
        self.spec = spec
        self._clock = clock
        self._render = render
        self._server = TcpServer(name, self._serve)
        self.address = self._server.address
        self._lock = threading.Lock()
        self._free = threading.Condition(self._lock)
        self._session: _Session | None = None
        self._lose = 0
        self._silent = False
        self._exposures = 0
        self._exposure = min(max(0.002, spec.exposure_min), spec.exposure_max)
        self._frame_rate = min(10.0, spec.frame_rate_max)

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()

    def stop(self) -> None:
        """End the connection and all threads; idempotent."""
        self._server.stop()

    def fault(self, name: str, count: int = 1) -> None:
        """`camera.frame_loss`: the next `count` exposures are lost; `camera.silent`: says nothing until `clear()`.

        Raises ValueError for a name that is not in `FAULTS`.
        """
        if name not in FAULTS:
            raise ValueError(f"unknown camera fault {name!r}; known: {', '.join(FAULTS)}")
        with self._lock:
            if name == "camera.frame_loss":
                self._lose += count
            else:
                self._silent = True

    def clear(self) -> None:
        """Take away all faults."""
        with self._lock:
            self._lose, self._silent = 0, False

    # --- one client ---

    def _serve(self, connection: socket.socket) -> None:
        session = _Session(self, connection)
        with self._free:
            # A client that has just gone may not have been noticed yet.
            if not self._free.wait_for(lambda: self._session is None, timeout=_HANDOVER):
                taken = True
            else:
                taken, self._session = False, session
        if taken:
            self._turn_away(connection)
            return
        session.start()
        try:
            while (request := _receive(connection)) is not None:
                session.reply(request, self._answer(session, request))
        except Rejected as error:
            session.send({"op": "error", "ok": False, "error": str(error)})
        finally:
            session.end()
            with self._free:
                self._session = None
                self._free.notify_all()
            session.join()

    def _turn_away(self, connection: socket.socket) -> None:
        connection.settimeout(2.0)
        request: dict[str, Any] = {}
        with contextlib.suppress(OSError, Rejected):
            request = _receive(connection) or {}
        error = f"camera {self.spec.serial} is in use by another client: close that one first"
        connection.sendall(_message({"op": request.get("op"), "id": request.get("id"), "ok": False, "error": error}))

    def _answer(self, session: _Session, request: dict[str, Any]) -> dict[str, Any]:
        operations: dict[str, Callable[[_Session, dict[str, Any]], dict[str, Any]]] = {
            "identify": self._identify,
            "configure": self._configure,
            "start": self._start,
            "stop": self._stop,
            "trigger": self._trigger,
            "latch": self._latch,
        }
        operation = operations.get(str(request.get("op")))
        try:
            if operation is None:
                raise Rejected(f"unknown op {request.get('op')!r}; known: {', '.join(operations)}")
            return {"ok": True, **operation(session, request)}
        except Rejected as error:
            return {"ok": False, "error": str(error)}

    # --- operations ---

    def _identify(self, session: _Session, request: dict[str, Any]) -> dict[str, Any]:
        spec = self.spec
        return {
            "model": spec.model,
            "serial": spec.serial,
            "firmware": spec.firmware,
            "width": spec.width,
            "height": spec.height,
            "pixel_format": "mono8",
            "exposure_min_s": spec.exposure_min,
            "exposure_max_s": spec.exposure_max,
            "frame_rate_max_hz": spec.frame_rate_max,
            "device_ns": self._device_ns(self._clock.now()),
        }

    def _configure(self, session: _Session, request: dict[str, Any]) -> dict[str, Any]:
        if session.running:
            raise Rejected("configure while free-running: stop first")
        spec = self.spec
        exposure = _number(request, "exposure_s", self._exposure, spec.exposure_min, spec.exposure_max, "s")
        frame_rate = self._rate(request, "frame_rate_hz", self._frame_rate)
        self._fits(exposure, frame_rate)
        self._exposure, self._frame_rate = exposure, frame_rate
        return {"exposure_s": exposure, "frame_rate_hz": frame_rate}

    def _start(self, session: _Session, request: dict[str, Any]) -> dict[str, Any]:
        if session.running:
            raise Rejected("the camera is free-running already: stop first")
        key = "frame_rate" if "frame_rate" in request else "frame_rate_hz"
        frame_rate = self._rate(request, key, self._frame_rate)
        self._fits(self._exposure, frame_rate)
        self._frame_rate = frame_rate
        first = self._next_frame_id()
        session.run(frame_rate)
        return {"exposure_s": self._exposure, "frame_rate_hz": frame_rate, "next_frame_id": first}

    def _stop(self, session: _Session, request: dict[str, Any]) -> dict[str, Any]:
        session.halt()
        return {}

    def _trigger(self, session: _Session, request: dict[str, Any]) -> dict[str, Any]:
        if session.running:
            raise Rejected("trigger while free-running: stop first")
        first = self._next_frame_id()
        session.trigger()
        return {"next_frame_id": first}

    def _latch(self, session: _Session, request: dict[str, Any]) -> dict[str, Any]:
        return {"device_ns": self._device_ns(self._clock.now())}

    # --- used by the session ---

    def _rate(self, request: dict[str, Any], key: str, default: float) -> float:
        return _number(request, key, default, 0.01, self.spec.frame_rate_max, "Hz")

    def _fits(self, exposure: float, frame_rate: float) -> None:
        if exposure * frame_rate > 1.0:
            raise Rejected(
                f"exposure {exposure:g} s does not fit into a frame at {frame_rate:g} Hz: "
                f"at most {1.0 / frame_rate:g} s at this rate, or at most {1.0 / exposure:g} Hz at this exposure"
            )

    def _device_ns(self, t: float) -> int:
        return round(self.spec.device_time(t) * 1e9)

    def _next_frame_id(self) -> int:
        with self._lock:
            return self._exposures + 1

    def _next_exposure(self) -> tuple[int, bool]:
        """Count an exposure: its frame id, and whether it is lost."""
        with self._lock:
            self._exposures += 1
            lost = self._lose > 0
            self._lose -= int(lost)
            return self._exposures, lost

    @property
    def silent(self) -> bool:
        """True while the camera says nothing."""
        with self._lock:
            return self._silent


@dataclass(frozen=True)
class _Exposure:
    frame_id: int
    begin: float
    duration: float


class _Session:
    """One client's acquisition: a thread that exposes on time, and one that renders and sends."""

    def __init__(self, peer: FramePeer, connection: socket.socket) -> None:
        self._peer = peer
        self._connection = connection
        self._sending = threading.Lock()
        self._wake = threading.Condition()
        self._ended = threading.Event()
        self._period: float | None = None
        self._next: float | None = None
        self._exposed: deque[_Exposure] = deque()
        self._generation = 0
        self._threads = [
            threading.Thread(target=self._expose, name=f"{peer.name}-expose", daemon=True),
            threading.Thread(target=self._deliver, name=f"{peer.name}-render", daemon=True),
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
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

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
        """Free-run from now on, at a rate of the device's own clock."""
        with self._wake:
            self._period = 1.0 / (frame_rate * (1.0 + 1e-6 * self._peer.spec.drift_ppm))
            self._next = self._peer._clock.now()
            self._wake.notify_all()

    def trigger(self) -> None:
        """Expose once, now. Raises Rejected while the exposure of the last trigger is going on."""
        with self._wake:
            if self._next is not None:
                raise Rejected("the exposure of the last trigger is not over yet: wait for its frame")
            self._next = self._peer._clock.now()
            self._wake.notify_all()

    def halt(self) -> None:
        """Stop exposing and forget what has not been sent: no frame follows."""
        with self._sending, self._wake:
            self._period = self._next = None
            self._exposed.clear()
            self._generation += 1

    def reply(self, request: dict[str, Any], answer: dict[str, Any]) -> None:
        """Answer a request."""
        self.send({"op": request.get("op"), "id": request.get("id"), **answer})

    def send(self, header: dict[str, Any], payload: bytes = b"") -> None:
        """Send a message, unless the camera is silent."""
        if not self._peer.silent:
            with self._sending:
                self._connection.sendall(_message(header, payload))

    def _expose(self) -> None:
        clock = self._peer._clock
        while True:
            with self._wake:
                while self._next is None and not self._ended.is_set():
                    self._wake.wait()
                if self._ended.is_set() or self._next is None:
                    return
                begin, duration, generation = self._next, self._peer._exposure, self._generation
                # The end of the exposure is awaited before anything counts: only then is the world's state known.
                while not self._ended.is_set() and generation == self._generation and clock.now() < begin + duration:
                    self._wake.wait(clock.wall(begin + duration - clock.now()))
                if self._ended.is_set():
                    return
                if generation != self._generation:
                    continue
                self._next = None if self._period is None else begin + self._period
                frame_id, lost = self._peer._next_exposure()
                if not lost and len(self._exposed) < BACKLOG:
                    self._exposed.append(_Exposure(frame_id, begin, duration))
                    self._wake.notify_all()

    def _deliver(self) -> None:
        while True:
            with self._wake:
                while not self._exposed and not self._ended.is_set():
                    self._wake.wait()
                if self._ended.is_set():
                    return
                exposure, generation = self._exposed.popleft(), self._generation
            try:
                image = self._peer._render(exposure.begin + 0.5 * exposure.duration, exposure.duration)
            except Exception:
                log.exception("%s: frame %d is lost: it cannot be rendered", self._peer.name, exposure.frame_id)
                continue
            try:
                self._send_frame(exposure, image, generation)
            except OSError:
                # The client has gone: the thread that reads its requests ends the session.
                return

    def _send_frame(self, exposure: _Exposure, image: NDArray[np.uint8], generation: int) -> None:
        spec = self._peer.spec
        if image.shape != (spec.height, spec.width) or image.dtype != np.uint8:
            raise ValueError(
                f"a picture must be uint8 of ({spec.height}, {spec.width}), not {image.dtype} {image.shape}"
            )
        header = {
            "op": "frame",
            "frame_id": exposure.frame_id,
            "device_ns": self._peer._device_ns(exposure.begin + spec.latency),
            "exposure_s": exposure.duration,
            "width": spec.width,
            "height": spec.height,
        }
        message = _message(header, image.tobytes())
        with self._sending:
            if generation == self._generation and not self._peer.silent:
                self._connection.sendall(message)


def _message(header: dict[str, Any], payload: bytes = b"") -> bytes:
    text = json.dumps(header).encode("utf-8")
    return _PREFIX.pack(MAGIC, len(text), len(payload)) + text + payload


def _receive(connection: socket.socket) -> dict[str, Any] | None:
    """The next request's header; None at the end of the connection. Raises Rejected when the stream is no protocol."""
    prefix = _read(connection, _PREFIX.size)
    if prefix is None:
        return None
    magic, length, payload = _PREFIX.unpack(prefix)
    if magic != MAGIC or length > _MAX_HEADER or payload > _MAX_HEADER:
        raise Rejected(
            f"not a message of frame stream version 1: it must begin with {MAGIC!r}, "
            f"header and payload of a request may have at most {_MAX_HEADER} bytes"
        )
    text = _read(connection, length)
    if text is None or _read(connection, payload) is None:
        return None
    try:
        request = json.loads(text)
    except ValueError as error:
        return {"op": f"a header that is not JSON ({error})"}
    return request if isinstance(request, dict) else {"op": "a header that is not a JSON object"}


def _read(connection: socket.socket, count: int) -> bytes | None:
    data = bytearray()
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            return None
        data += part
    return bytes(data)


def _number(request: dict[str, Any], key: str, default: float, low: float, high: float, unit: str) -> float:
    value = request.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Rejected(f"{key} {value!r} is not a number; allowed {low:g} to {high:g} {unit}")
    if not low <= value <= high:
        raise Rejected(f"{key} {value:g} {unit} is out of range; allowed {low:g} to {high:g} {unit}")
    return float(value)
