"""A camera on the network: frame stream protocol, version 1 (`docs/reference/frame-stream.md`).

Here are the requests and the rule that a camera has one client; the pictures are the session's.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_backends.clock import WorldClock
from sim_backends.models.camera import FAULTS, CameraSpec, CameraState
from sim_backends.peers.camera.frame_session import BACKLOG, Exposure, FrameSession, Render
from sim_backends.peers.camera.frame_wire import Rejected, message, number, receive
from sim_backends.peers.server import TcpServer

__all__ = ["BACKLOG", "FAULTS", "CameraSpec", "FramePeer", "Render"]

_HANDOVER = 0.3
"""Wall seconds that a second client waits for the first one to go."""
_SLOWEST = 0.01
"""Lowest frame rate in Hz."""


class FramePeer:
    """Serves one camera to one client at a time at `address` (`127.0.0.1:port`)."""

    def __init__(self, name: str, clock: WorldClock, render: Render, spec: CameraSpec) -> None:
        """`render` is called in the session's thread, once the exposure that it is to show is over."""
        self.name = name
        self.camera = CameraState(spec)
        self._clock = clock
        self._render = render
        self._server = TcpServer(name, self._serve)
        self.address = self._server.address
        self._free = threading.Condition()
        self._session: FrameSession | None = None

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()

    def stop(self) -> None:
        """End the connection and all threads; idempotent."""
        self._server.stop()

    def fault(self, name: str, count: int = 1) -> None:
        """Cause a fault of `FAULTS` (see `CameraState.fault`); ValueError for another name."""
        self.camera.fault(name, count)

    def clear(self) -> None:
        """Take away all faults."""
        self.camera.clear()

    def _serve(self, connection: socket.socket) -> None:
        session = FrameSession(self.name, self.camera, self._clock, self._render, partial(self._send_frame, connection))
        if not self._take(session):
            self._turn_away(connection)
            return

        def send(header: dict[str, Any]) -> None:
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
        request: dict[str, Any] = {}
        with contextlib.suppress(OSError, Rejected):
            request = receive(connection) or {}
        error = f"camera {self.camera.spec.serial} is in use by another client: close that one first"
        connection.sendall(message({"op": request.get("op"), "id": request.get("id"), "ok": False, "error": error}))

    def _send_frame(self, connection: socket.socket, exposure: Exposure, image: NDArray[np.uint8]) -> None:
        spec = self.camera.spec
        header = {
            "op": "frame",
            "frame_id": exposure.frame_id,
            "device_ns": spec.device_ns(exposure.begin + spec.latency),
            "exposure_s": exposure.duration,
            "width": spec.width,
            "height": spec.height,
        }
        if not self.camera.silent:
            connection.sendall(message(header, image.tobytes()))

    # --- requests ---

    def _answer(self, session: FrameSession, request: dict[str, Any]) -> dict[str, Any]:
        operations: dict[str, Callable[[FrameSession, dict[str, Any]], dict[str, Any]]] = {
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

    def _identify(self, session: FrameSession, request: dict[str, Any]) -> dict[str, Any]:
        spec = self.camera.spec
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
            **self._latch(session, request),
        }

    def _configure(self, session: FrameSession, request: dict[str, Any]) -> dict[str, Any]:
        if session.running:
            raise Rejected("configure while free-running: stop first")
        camera = self.camera
        limits = (camera.spec.exposure_min, camera.spec.exposure_max)
        exposure = number(request, "exposure_s", camera.exposure, *limits, "s")
        self._set(exposure, self._rate(request, "frame_rate_hz"))
        return {"exposure_s": camera.exposure, "frame_rate_hz": camera.frame_rate}

    def _start(self, session: FrameSession, request: dict[str, Any]) -> dict[str, Any]:
        if session.running:
            raise Rejected("the camera is free-running already: stop first")
        camera = self.camera
        self._set(camera.exposure, self._rate(request, "frame_rate" if "frame_rate" in request else "frame_rate_hz"))
        first = camera.next_frame_id
        session.run(camera.frame_rate)
        return {"exposure_s": camera.exposure, "frame_rate_hz": camera.frame_rate, "next_frame_id": first}

    def _stop(self, session: FrameSession, request: dict[str, Any]) -> dict[str, Any]:
        session.halt()
        return {}

    def _trigger(self, session: FrameSession, request: dict[str, Any]) -> dict[str, Any]:
        if session.running:
            raise Rejected("trigger while free-running: stop first")
        first = self.camera.next_frame_id
        session.trigger()
        return {"next_frame_id": first}

    def _latch(self, session: FrameSession, request: dict[str, Any]) -> dict[str, Any]:
        return {"device_ns": self.camera.spec.device_ns(self._clock.now())}

    def _rate(self, request: dict[str, Any], key: str) -> float:
        return number(request, key, self.camera.frame_rate, _SLOWEST, high=self.camera.spec.frame_rate_max, unit="Hz")

    def _set(self, exposure: float, frame_rate: float) -> None:
        if exposure * frame_rate > 1.0:
            raise Rejected(
                f"exposure {exposure:g} s does not fit into a frame at {frame_rate:g} Hz: "
                f"at most {1.0 / frame_rate:g} s at this rate, or at most {1.0 / exposure:g} Hz at this exposure"
            )
        self.camera.exposure, self.camera.frame_rate = exposure, frame_rate
