"""What peers serve with on the loopback interface: TCP with a thread per client, a serial line, lines of JSON.

Whatever a client does (vanish, send garbage, stop reading), it costs its own connection only.
"""

import contextlib
import json
import logging
import os
import select
import socket
import threading
import tty
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import numpy as np

log = logging.getLogger(__name__)


class Peer(Protocol):
    """What every peer offers."""

    def start(self) -> None:
        """Begin to serve."""

    def stop(self) -> None:
        """End all connections and threads; idempotent."""


class TcpServer:
    """Accepts clients on a free port of 127.0.0.1 and runs `handle(connection)` in a thread of its own for each.
    `handle` returns when its connection ends; `stop()` shuts every connection down, so that reading from it ends."""

    def __init__(self, name: str, handle: Callable[[socket.socket], None]) -> None:
        self.name = name
        self._handle = handle
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.host, self.port = self._listener.getsockname()
        self._lock = threading.Lock()
        self._connections: dict[socket.socket, threading.Thread] = {}
        self._stopping = threading.Event()
        self._acceptor = threading.Thread(target=self._accept, name=f"{name}-accept", daemon=True)

    @property
    def address(self) -> str:
        """Where it listens, `host:port`."""
        return f"{self.host}:{self.port}"

    def start(self) -> None:
        """Begin to accept clients."""
        self._acceptor.start()

    def stop(self) -> None:
        """End all connections and threads; idempotent."""
        self._stopping.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.drop()
        if self._acceptor.ident is not None:
            self._acceptor.join()
        with self._lock:
            threads = list(self._connections.values())
        for thread in threads:
            thread.join()

    def drop(self) -> None:
        """End all present connections, as a cable that is pulled."""
        with self._lock:
            for connection in self._connections:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while not self._stopping.is_set():
            try:
                connection, peer = self._listener.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            thread = threading.Thread(
                target=self._run, args=(connection,), name=f"{self.name}-client-{peer[1]}", daemon=True
            )
            with self._lock:
                if self._stopping.is_set():
                    connection.close()
                    return
                self._connections[connection] = thread
                thread.start()

    def _run(self, connection: socket.socket) -> None:
        try:
            self._handle(connection)
        except OSError as error:
            log.debug("%s: client gone: %s", self.name, error)
        except Exception:
            log.exception("%s: connection ended by an error of the simulator", self.name)
        finally:
            with self._lock:
                self._connections.pop(connection, None)
                connection.close()


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


Operation = Callable[[Mapping[str, Any]], Mapping[str, object] | None]
"""Carries out a request and gives what its reply says beside "ok".

ValueError, TypeError, KeyError or IndexError refuse the request.
"""


class JsonLinesPeer(TcpServer):
    """Serves at `address` one JSON object per line each way: `operations` by the request's "op". Replies are {"ok":
    true, …} or {"ok": false, "error": …}; arrays are told as lists."""

    def __init__(self, name: str, operations: Mapping[str, Operation], longest: int = 64 * 1024) -> None:
        """A request is at most `longest` bytes."""
        super().__init__(name, self._talk)
        self._operations = operations
        self._longest = longest

    def _talk(self, connection: socket.socket) -> None:
        with connection.makefile("rb") as lines:
            while line := lines.readline(self._longest):
                connection.sendall(json.dumps(self._answer(line), default=_plain).encode() + b"\n")

    def _answer(self, line: bytes) -> dict[str, object]:
        try:
            request = json.loads(line)
            name = request["op"]
        except (ValueError, TypeError, KeyError):
            return {"ok": False, "error": 'a request is one line with a JSON object that has "op"'}
        if (operation := self._operations.get(str(name))) is None:
            return {"ok": False, "error": f"unknown op {name!r}; known: {', '.join(self._operations)}"}
        try:
            return {"ok": True, **(operation(request) or {})}
        except (ValueError, TypeError, KeyError, IndexError) as error:
            told = str(error) if type(error) is ValueError else f"{type(error).__name__}: {error}"
            return {"ok": False, "error": told}


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not fit for JSON")
