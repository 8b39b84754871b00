"""Serial ports, opened for one program alone, and what came unasked over a socket."""

import logging
import socket
from contextlib import suppress
from typing import ClassVar, cast

import serial
from serial.urlhandler import protocol_socket

from drivers.clock import Clock
from drivers.errors import NotConnectedError
from drivers.last_words import descriptor_of

WRITE_TIMEOUT_S = 2.0
"""Wall seconds after which a port that takes no bytes counts as stuck."""
PARITIES = {"none": serial.PARITY_NONE, "even": serial.PARITY_EVEN, "odd": serial.PARITY_ODD}
FAILURES = (serial.SerialException, OSError)
"""What a port raises when its other end is gone."""

log = logging.getLogger(__name__)


class SocketPort(protocol_socket.Serial):
    """A port at `socket://HOST:PORT`. pyserial's own waits after each closing, for servers that take one client at a
    time: here who opens the same port again does."""

    REOPEN_S = 0.3
    _socket: socket.socket
    _clock = Clock()
    _free: ClassVar[dict[str | None, float]] = {}

    def open(self) -> None:
        """Connect, at the earliest `REOPEN_S` wall seconds after this program has closed the port."""
        self._clock.sleep_until(self._free.get(self.port, 0.0))
        super().open()

    def close(self) -> None:
        """Close the port at once; idempotent."""
        if self.is_open:
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)
            self._socket.close()
            self.is_open = False
            self._free[self.port] = self._clock.now() + self.REOPEN_S


def open_port(
    name: str, url: str, *, baud: int, timeout: float, parity: str = "none", stop_bits: int = 1
) -> serial.Serial:
    """A device file or pyserial URL, opened; `timeout` in wall seconds is that of a read. No other program that asks
    for a lock has the port meanwhile. Raises `NotConnectedError` for the device `name`."""
    try:
        make = cast("type[serial.Serial]", SocketPort) if url.startswith("socket://") else serial.serial_for_url
        port = make(
            url, baudrate=baud, timeout=timeout, write_timeout=WRITE_TIMEOUT_S, parity=PARITIES[parity],
            stopbits=stop_bits, exclusive=True,
        )  # fmt: skip
    except (*FAILURES, ValueError) as error:
        raise NotConnectedError(
            name, f"port {url} cannot be opened: {error}. Check the address and that nothing else has it open"
        ) from error
    if descriptor_of(port) is None:
        log.warning("%s: nobody will stop it if this process is killed: port %s is no file of this computer", name, url)
    return port


def forget_unasked(link: socket.socket) -> None:
    """Throw away what came before a question: it answers nothing, and the answer would be taken for the next one's. The
    link waits for nothing afterwards until it is given a timeout. Raises OSError when the other side closed it."""
    link.setblocking(False)
    try:
        # As much as a device that babbles can have sent; more is told by the answers.
        for _ in range(1000):
            if link.recv(4096) == b"":
                raise ConnectionResetError("it was closed by the other side")
    except BlockingIOError:
        return
