"""The text protocol of a Robotiq gripper: variables that are read with GET and written with SET, over one TCP socket.

Replies have no end mark: `ack` for a SET, `NAME value` for a GET. All of what the gripper knows is in the gripper, so a
connection that was lost is simply made again by the next request. Source: docs/how-to/other-makes.md, section 3.
"""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Mapping

from drivers.errors import DeadlineError, DeviceFault, NotConnectedError
from drivers.interfaces import LinkStatistics

REPLY_TIMEOUT_S = 1.0
"""Wall seconds for a reply: the controller's program that serves the socket asks the gripper every 8 ms or so."""
_QUIET_S = 0.002
"""Wall seconds after which a reply without an end mark is whole: it is sent at once, but may come in two pieces."""
_ATTEMPTS = 2
_ACK = re.compile(rb"ack\s*")


class BadClawReply(Exception):
    """What came is no reply to what was asked."""


class RobotiqLink:
    """The connection to `address` ("HOST:PORT") of the device `name`; `NotConnectedError` when nobody takes it."""

    def __init__(self, name: str, address: str, statistics: LinkStatistics) -> None:
        self.name = name
        self.address = address
        self._statistics = statistics
        self._lock = threading.Lock()
        self._closed = False
        self._socket: socket.socket | None = self._connected()

    def get(self, variable: str) -> int:
        """Read a variable."""
        wanted = re.compile(rb"\s*" + variable.encode() + rb"\s+(-?\d+)\s*")

        def value(data: bytes) -> int:
            if (found := wanted.fullmatch(data)) is None:
                raise BadClawReply(f"{data!r} came")
            return int(found[1])

        return value(self._ask(f"GET {variable}\n".encode(), wanted))

    def set(self, values: Mapping[str, int]) -> None:
        """Write variables, all of them at once."""
        words = " ".join(f"{name} {value}" for name, value in values.items())
        self._ask(f"SET {words}\n".encode(), _ACK)

    def close(self) -> None:
        """Close the connection; every later request raises `NotConnectedError`. Idempotent."""
        with self._lock:
            self._closed = True
            self._hang_up()

    def _ask(self, request: bytes, reply: re.Pattern[bytes]) -> bytes:
        """Send `request` and give what `reply` matches. All requests mean the same when they are heard twice."""
        problem = ""
        for attempt in range(_ATTEMPTS):
            if attempt:
                self._statistics.count("retries")
            with self._lock:
                if self._closed:
                    raise NotConnectedError(self.name, "was closed. Open it again")
                if self._socket is None:
                    self._socket = self._connected()
                before = time.monotonic()
                try:
                    data = self._exchange(self._socket, request, reply)
                    self._statistics.traffic.received(data)
                except TimeoutError:
                    # A late reply would answer the next request: it dies with this connection.
                    self._statistics.count("timeouts")
                    self._hang_up()
                    problem = f"nothing came within {REPLY_TIMEOUT_S:g} s"
                    continue
                except OSError as error:
                    self._statistics.count("link_lost")
                    self._hang_up()
                    raise DeviceFault(
                        self.name,
                        "claw.link_lost",
                        f"the connection to {self.address} failed: {error}; the claw stays as it is",
                        recoverable=True,
                        hint="See that the arm's controller is on and that its Robotiq program (URCap) runs.",
                    ) from error
            if reply.fullmatch(data):
                self._statistics.add_round_trip(time.monotonic() - before)
                return data
            self._statistics.count("bad_replies")
            problem = f"{data!r} came"
        raise DeadlineError(
            self.name,
            f"no valid reply to {request!r}, {_ATTEMPTS} attempts ({problem}). Check that {self.address} is the "
            "gripper's port (63352 of the arm's controller) and that a gripper is connected there",
        )

    def _exchange(self, link: socket.socket, request: bytes, reply: re.Pattern[bytes]) -> bytes:
        link.setblocking(False)
        try:
            # What came unasked, or too late, answers nothing.
            if link.recv(4096) == b"":
                raise ConnectionResetError("it was closed by the other side")
        except BlockingIOError:
            pass
        link.settimeout(REPLY_TIMEOUT_S)
        link.sendall(request)
        self._statistics.traffic.sent(request)
        data = b""
        until = time.monotonic() + REPLY_TIMEOUT_S
        while True:
            whole = bool(reply.fullmatch(data))
            if data.endswith(b"\n"):
                return data
            link.settimeout(_QUIET_S if whole else max(0.001, until - time.monotonic()))
            try:
                chunk = link.recv(4096)
            except TimeoutError:
                if whole or data:
                    return data
                raise
            if not chunk:
                raise ConnectionResetError("it was closed by the other side")
            data += chunk

    def _connected(self) -> socket.socket:
        host, _, port = self.address.rpartition(":")
        try:
            link = socket.create_connection((host, int(port)), timeout=REPLY_TIMEOUT_S)
        except OSError as error:
            raise NotConnectedError(
                self.name,
                f"{self.address} takes no connection: {error}. Check the address and that the arm's controller is on "
                "with the gripper's program (URCap) installed",
            ) from error
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return link

    def _hang_up(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None
