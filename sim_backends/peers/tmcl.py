"""The rail's wire: TMCL requests over TCP (as behind a serial server) or over a pseudo terminal.

Framing as on the serial line: nine bytes make a request, and an incomplete one is forgotten after a pause.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import tty
from collections.abc import Callable
from functools import partial

from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel
from sim_backends.peers.server import TcpServer
from sim_backends.peers.tmcl_module import TmclModule

FAULTS = ("rail.drop_reply", "rail.late_reply", "rail.reset")
LATE_S = 0.2
"""Wall seconds by which `rail.late_reply` delays every reply."""
_REQUEST = 9
_PAUSE = 0.05
"""Wall seconds of silence after which the rest of an incomplete request is forgotten."""


class TmclPeer:
    """Serves one module at `url` (`socket://127.0.0.1:port` for pyserial) and, on request, at the device `pty`."""

    def __init__(self, model: RailModel, clock: WorldClock, pty: bool = False) -> None:
        self.module = TmclModule(model, clock)
        self._server = TcpServer("rail", self._serve_socket)
        self.url = f"socket://{self._server.address}"
        self.pty: str | None = None
        self._drop = 0
        self._late = False
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._terminal: tuple[int, int] | None = None
        if pty:
            master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            self._terminal, self.pty = (master, slave), os.ttyname(slave)
            self._reader = threading.Thread(target=self._serve_pty, args=(master,), name="rail-pty", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()
        if self._terminal:
            self._reader.start()

    def stop(self) -> None:
        """End all connections and threads; idempotent."""
        self._stopping.set()
        self._server.stop()
        if self._terminal:
            if self._reader.ident is not None:
                self._reader.join()
            for descriptor in self._terminal:
                os.close(descriptor)
            self._terminal = None

    def fault(self, name: str) -> None:
        """Cause a fault of `FAULTS`; ValueError for another name.

        `rail.drop_reply`: the next request is carried out, but its reply is lost. `rail.late_reply`: from now on every
        reply comes `LATE_S` after its request was carried out. `rail.reset`: the module starts anew.
        """
        match name:
            case "rail.drop_reply":
                with self._lock:
                    self._drop += 1
            case "rail.late_reply":
                self._late = True
            case "rail.reset":
                self.module.reset()
            case _:
                raise ValueError(f"unknown rail fault {name!r}; known: {', '.join(FAULTS)}")

    def clear(self) -> None:
        """Take away all faults; a module that was reset stays so."""
        with self._lock:
            self._drop = 0
        self._late = False

    def _serve_socket(self, connection: socket.socket) -> None:
        self._serve(connection.fileno(), lambda: connection.recv(4096), connection.sendall)

    def _serve_pty(self, master: int) -> None:
        # The slave side is kept open here as well, so that a client may come and go without a hang-up.
        with contextlib.suppress(OSError):
            self._serve(master, lambda: os.read(master, 4096), partial(_transmit, master))

    def _serve(self, descriptor: int, read: Callable[[], bytes], write: Callable[[bytes], object]) -> None:
        pending = b""
        while not self._stopping.is_set():
            if not select.select([descriptor], [], [], _PAUSE)[0]:
                pending = b""
                continue
            data = read()
            if not data:
                return
            pending += data
            while len(pending) >= _REQUEST:
                reply = self.module.handle(pending[:_REQUEST])
                pending = pending[_REQUEST:]
                if self._late:
                    self._stopping.wait(LATE_S)
                if reply is not None and not self._lost():
                    write(reply)

    def _lost(self) -> bool:
        with self._lock:
            if self._drop:
                self._drop -= 1
                return True
            return False


def _transmit(descriptor: int, data: bytes) -> None:
    """Send as a serial line does: what nobody reads is lost."""
    with contextlib.suppress(BlockingIOError):
        os.write(descriptor, data)
