"""pyserial URL handler `bufsocket://HOST:PORT`: its `socket://`, with what has arrived read in one go.

python-can's slcan asks for every byte by itself, which on a plain socket costs two system calls each: at the vehicle's
1000 frames a second that is a third of a processor.
"""

from __future__ import annotations

import select
import socket

from serial.urlhandler import protocol_socket

_CHUNK = 4096
SCHEME = "bufsocket://"


class Serial(protocol_socket.Serial):
    """A `socket://` port with a read buffer; one thread may read while another writes."""

    _socket: socket.socket
    _buffer = b""

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting."""
        if not self._buffer and select.select([self._socket], [], [], 0)[0]:
            self._buffer = super().read(1) + self._rest()
        return len(self._buffer)

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes, waiting for the first as long as the port's timeout says."""
        if not self._buffer:
            self._buffer = super().read(1)
        data, self._buffer = self._buffer[:size], self._buffer[size:]
        return data

    def reset_input_buffer(self) -> None:
        """Forget what has arrived."""
        self._buffer = b""
        super().reset_input_buffer()

    def _rest(self) -> bytes:
        try:
            return self._socket.recv(_CHUNK)
        except BlockingIOError:
            return b""


def serial_class_for_url(url: str) -> tuple[str, type[Serial]]:
    """What pyserial asks a URL handler: the URL and the class that opens it."""
    return url.replace(SCHEME, "socket://", 1), Serial
