"""A controller of another kind: an arm behind a cable on which its RTDE packets come out changed."""

import socket
import struct
from collections.abc import Callable, Iterable

from tests.support.wire.cable import Cable

RTDE = 30004
HEADER = struct.Struct(">HB")
Change = Callable[[str, bytes], Iterable[bytes]]
"""Kind and payload of a packet of the arm: what the client gets instead, each with its header."""


def packet(kind: str, payload: bytes) -> bytes:
    return HEADER.pack(HEADER.size + len(payload), ord(kind)) + payload


class Meddler(Cable):
    """Hands each RTDE packet of the arm at `far_end` to `change`."""

    def __init__(self, far_end: str, change: Change) -> None:
        self._change = change
        self._kept: dict[socket.socket, bytes] = {}
        super().__init__(far_end)

    def _passed(self, end: socket.socket, data: bytes) -> bytes:
        if end.getpeername()[1] != RTDE:
            return data
        data, out = self._kept.get(end, b"") + data, b""
        while len(data) >= HEADER.size and len(data) >= (size := HEADER.unpack_from(data)[0]):
            out += b"".join(self._change(chr(data[2]), data[HEADER.size : size]))
            data = data[size:]
        self._kept[end] = data
        return out
