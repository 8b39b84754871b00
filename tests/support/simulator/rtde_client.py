"""An RTDE client that knows nothing of the simulated arm's code."""

import socket
import struct


class Rtde:
    """One RTDE connection of a client that knows nothing of the simulated arm's code."""

    def __init__(self, address: str, version: int = 2) -> None:
        self.socket = socket.create_connection((address, 30004), timeout=5.0)
        self._rest = b""
        if version == 2:
            assert self.ask("V", struct.pack(">H", 2)) == b"\1"

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """Send one package; the reply of the same kind."""
        self.socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)
        while True:
            found, content = self.next()
            if found == kind:
                return content

    def notify(self, payload: bytes) -> None:
        self.socket.sendall(struct.pack(">HB", 3 + len(payload), ord("U")) + payload)

    def next(self) -> tuple[str, bytes]:
        while len(self._rest) < 3 or len(self._rest) < struct.unpack_from(">H", self._rest)[0]:
            data = self.socket.recv(65536)
            assert data, "the controller closed the connection"
            self._rest += data
        size, kind = struct.unpack_from(">HB", self._rest)
        content, self._rest = self._rest[3:size], self._rest[size:]
        return chr(kind), content

    def states(self, count: int) -> list[bytes]:
        found: list[bytes] = []
        while len(found) < count:
            kind, content = self.next()
            if kind == "U":
                found.append(content)
        return found
