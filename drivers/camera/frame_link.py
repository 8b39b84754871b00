"""The TCP connection to a camera: requests with their replies, and frames as they come, told apart by one thread.

Messages of the frame stream protocol, version 1 (docs/reference/frame-stream.md): magic, lengths, JSON header,
payload."""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from drivers.clock import Clock
from drivers.errors import ConfigError, DeadlineError, DeviceFault, NotConnectedError
from drivers.interfaces import LinkStatistics

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
        self,
        name: str,
        address: str,
        clock: Clock,
        *,
        take_frame: Callable[[Header, bytearray, float], None],
        lost: Callable[[], None],
        statistics: LinkStatistics,
    ) -> None:
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
        """Ask the camera; returns the reply and the host times of sending and of its arrival.

        Raises `DeviceFault` when the camera refuses (camera.refused) or is lost, `DeadlineError` when it is silent.
        """
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
                        if header.get("id") in (self._awaited, None):
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
