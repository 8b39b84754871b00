"""A cable to an arm that can be pulled: bytes pass through as long as it is in, and are kept while it is out."""

import itertools
import select
import socket
import threading

PORTS = (30004, 30003, 30002, 30001, 29999)


class Cable:
    """Passes every port of the arm at `far_end` on, `but` some; `address` is the near end. To be used as a context."""

    def __init__(self, far_end: str, but: tuple[int, ...] = (), silent: tuple[int, ...] = ()) -> None:
        """A connection to a `silent` port is taken, and nothing comes of it."""
        ports = [port for port in PORTS if port not in but]
        self._far_end = far_end
        self._listeners: list[socket.socket] = []
        for number in itertools.count(2):
            self.address = f"127.0.3.{number}"
            try:
                self._listeners = [socket.create_server((self.address, port)) for port in ports]
                self._deaf = [socket.create_server((self.address, port)) for port in silent]
                break
            except OSError:
                continue
        self._ports = dict(zip(self._listeners, ports, strict=True))
        self._peers: dict[socket.socket, socket.socket] = {}
        self._in, self._over = threading.Event(), threading.Event()
        self._in.set()
        self._thread = threading.Thread(target=self._pass_on, daemon=True)
        self._thread.start()

    def pull(self) -> None:
        """No byte passes any more, and no end is told."""
        self._in.clear()

    def plug(self) -> None:
        """In again."""
        self._in.set()

    def __enter__(self) -> "Cable":
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._in.set()
        self._thread.join(5.0)
        for end in (*self._listeners, *self._deaf, *self._peers):
            end.close()

    def _pass_on(self) -> None:
        while not self._over.is_set():
            self._in.wait()
            for end in select.select([*self._listeners, *self._peers], [], [], 0.01)[0]:
                if not self._in.is_set():
                    break
                if end in self._ports:
                    self._connect(end)
                elif end in self._peers:
                    self._move(end)

    def _connect(self, listener: socket.socket) -> None:
        near, _ = listener.accept()
        far = socket.create_connection((self._far_end, self._ports[listener]))
        for end, peer in ((near, far), (far, near)):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._peers[end] = peer

    def _passed(self, end: socket.socket, data: bytes) -> bytes:
        """What becomes of bytes that came from `end`."""
        return data

    def _move(self, end: socket.socket) -> None:
        peer = self._peers[end]
        try:
            data = end.recv(65536)
            if data:
                peer.sendall(self._passed(end, data))
                return
        except OSError:
            pass
        for side in (end, peer):
            del self._peers[side]
            side.close()
