"""A TCP server on the loopback interface: one thread per client, all of them ended by `stop()`.

Whatever a client does (vanish, send garbage, stop reading), it costs its own connection only.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)


class TcpServer:
    """Accepts clients on a free port of 127.0.0.1 and runs `handle(connection)` in a thread of its own for each.

    `handle` returns when its connection ends; `stop()` shuts every connection down, so that reading from it ends.
    """

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
                target=self._serve, args=(connection,), name=f"{self.name}-client-{peer[1]}", daemon=True
            )
            with self._lock:
                if self._stopping.is_set():
                    connection.close()
                    return
                self._connections[connection] = thread
                thread.start()

    def _serve(self, connection: socket.socket) -> None:
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
