"""pyserial URL handler `bufsocket://HOST:PORT`: its `socket://`, with what has arrived read in one go.

python-can's slcan asks for every byte by itself, which on a plain socket costs two system calls each: at the vehicle's
1000 frames a second that is a third of a processor. And pyserial calls a write late that was taken at once when the
machine does not run the writer for the length of the timeout.
"""

import select
import time
from typing import Any

from serial import PortNotOpenError, SerialException, SerialTimeoutException

from drivers.ports import SocketPort

_CHUNK = 4096
SCHEME = "bufsocket://"


class Serial(SocketPort):
    """A `socket://` port with a read buffer; one thread may read while another writes."""

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

    def write(self, data: Any) -> int:
        """Send all of `data`; raises when the other end takes none of it for as long as the port's write timeout says.
        Raises SerialTimeoutException then, SerialException when the connection is lost."""
        if not self.is_open:
            raise PortNotOpenError
        left, timeout = memoryview(data), self.write_timeout
        end = None if timeout is None else time.monotonic() + timeout
        while left:
            try:
                left = left[self._socket.send(left) :]
            except BlockingIOError:
                wait = None if end is None else max(0.0, end - time.monotonic())
                if not select.select([], [self._socket], [], wait)[1]:
                    raise SerialTimeoutException("write timeout") from None
            except OSError as error:
                raise SerialException(f"write failed: {error}") from error
        return len(data)

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
