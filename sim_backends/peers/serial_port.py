"""A simulated device's end of a serial line: over TCP (as behind a serial server), and on request a pseudo terminal."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import tty
from collections.abc import Callable
from functools import partial

from sim_backends.peers.server import TcpServer

PAUSE_S = 0.05
"""Wall seconds of silence after which the rest of an incomplete request is forgotten."""

Take = Callable[[bytes, Callable[[bytes], object]], bytes]
"""Handles what is whole of the bytes that came, replies with the function it is given, and returns the rest."""


class SerialServer:
    """Serves `take` at `url` (`socket://127.0.0.1:port` for pyserial) and, with `pty`, at that device file."""

    def __init__(self, name: str, take: Take, *, pty: bool = False) -> None:
        self._take = take
        self._server = TcpServer(name, self._serve_socket)
        self.url = f"socket://{self._server.address}"
        self.pty: str | None = None
        self.stopping = threading.Event()
        self._terminal: tuple[int, int] | None = None
        if pty:
            master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            self._terminal, self.pty = (master, slave), os.ttyname(slave)
            self._reader = threading.Thread(target=self._serve_pty, args=(master,), name=f"{name}-pty", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()
        if self._terminal:
            self._reader.start()

    def stop(self) -> None:
        """End all connections and threads; idempotent."""
        self.stopping.set()
        self._server.stop()
        if self._terminal:
            if self._reader.ident is not None:
                self._reader.join()
            for descriptor in self._terminal:
                os.close(descriptor)
            self._terminal = None

    def drop(self) -> None:
        """End the present connections over TCP, as a cable that is pulled."""
        self._server.drop()

    def _serve_socket(self, connection: socket.socket) -> None:
        self._serve(connection.fileno(), lambda: connection.recv(4096), connection.sendall)

    def _serve_pty(self, master: int) -> None:
        # The slave side is kept open here as well, so that a client may come and go without a hang-up.
        with contextlib.suppress(OSError):
            self._serve(master, lambda: os.read(master, 4096), partial(_transmit, master))

    def _serve(self, descriptor: int, read: Callable[[], bytes], write: Callable[[bytes], object]) -> None:
        pending = b""
        while not self.stopping.is_set():
            if not select.select([descriptor], [], [], PAUSE_S)[0]:
                pending = b""
                continue
            if not (data := read()):
                return
            pending = self._take(pending + data, write)


def _transmit(descriptor: int, data: bytes) -> None:
    """Send as a serial line does: what nobody reads is lost."""
    with contextlib.suppress(BlockingIOError):
        os.write(descriptor, data)
