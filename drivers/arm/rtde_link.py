"""One RTDE connection of this process' own, beside that of the vendor's library, for what that does not offer.

Source: the maker's RTDE guide, version 2; docs/protocols.md, section 1.
"""

from __future__ import annotations

import socket
import struct

from drivers.clock import Clock
from drivers.traffic import Traffic

PORT = 30004
VERSION, RATE_HZ = 2, 500.0
VARIABLES = (
    "timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "actual_TCP_force", "actual_digital_input_bits",
    "actual_digital_output_bits", "robot_mode", "robot_status_bits", "safety_status_bits", "runtime_state",
    "payload", "payload_cog",
)  # fmt: skip
"""What the driver reads of the arm. Here, since the child process reads them too and starts without `numpy`."""
_HEADER = struct.Struct(">HB")


class RtdeLink:
    """A connection to the arm at `address`; packets one at a time, all within `timeout` wall seconds of its opening.

    Raises `TimeoutError` or another `OSError`.
    """

    def __init__(self, address: str, clock: Clock, timeout: float, traffic: Traffic | None = None) -> None:
        self._clock = clock
        self._traffic = traffic or Traffic()
        self._deadline = clock.now() + timeout * clock.rate
        self._rest = b""
        self._socket = socket.create_connection((address, PORT), timeout=timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> RtdeLink:
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()

    def send(self, kind: str, payload: bytes) -> None:
        """One packet to the controller."""
        packet = _HEADER.pack(_HEADER.size + len(payload), ord(kind)) + payload
        self._socket.sendall(packet)
        self._traffic.sent(packet)

    def receive(self, kind: str) -> bytes:
        """The payload of the next packet of this kind; others are passed over."""
        while True:
            head = self._take(_HEADER.size)
            size, got = _HEADER.unpack(head)
            if size < _HEADER.size:
                raise ConnectionAbortedError(f"a packet of {size} bytes came, which is none of RTDE")
            payload = self._take(size - _HEADER.size)
            self._traffic.received(head + payload)
            if chr(got) == kind:
                return payload

    def ask(self, kind: str, payload: bytes) -> bytes:
        """The reply to a packet, which is of its kind."""
        self.send(kind, payload)
        return self.receive(kind)

    def _take(self, size: int) -> bytes:
        while len(self._rest) < size:
            left = self._clock.wall(self._deadline - self._clock.now())
            if left <= 0:
                raise TimeoutError
            self._socket.settimeout(left)
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionResetError("the arm closed the connection")
            self._rest += data
        taken, self._rest = self._rest[:size], self._rest[size:]
        return taken
