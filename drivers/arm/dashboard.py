"""The arm's dashboard server: one line of text each way, for who the arm is and for what works without a program.

A plain socket with a deadline on every call, so that it can stop the arm when everything else has failed.
Source: the maker's dashboard reference; docs/reference/protocols.md, section 1.
"""

import socket
import threading
import time

from drivers.errors import DeadlineError, NotConnectedError
from drivers.interfaces import Traffic
from drivers.ports import forget_unasked

PORT = 29999


_NOT_KNOWN = "could not understand"


def unknown(reply: str) -> bool:
    """Whether a server says so of a question that its version does not know."""
    return reply.lower().startswith(_NOT_KNOWN)


class Dashboard:
    """Asks the dashboard server of the arm at `address`; every call ends within `timeout` wall seconds."""

    def __init__(self, name: str, address: str, timeout: float = 1.0, traffic: Traffic | None = None) -> None:
        self._name = name
        self._address = address
        self._timeout = timeout
        self._traffic = traffic or Traffic()
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._rest = b""

    def ask(self, command: str) -> str:
        """The reply to one command. `NotConnectedError` without a server, `DeadlineError` when it is silent."""
        deadline = time.monotonic() + self._timeout
        if not self._lock.acquire(timeout=self._timeout):
            raise DeadlineError(self._name, f"the dashboard server was busy for {self._timeout:g} s")
        try:
            if self._socket is not None:
                try:
                    forget_unasked(self._socket)
                except OSError:  # The server was started again meanwhile; nothing was sent yet.
                    self._drop()
            if self._socket is None:
                self._connect(deadline)
            assert self._socket is not None
            self._rest = b""
            self._socket.settimeout(_left(deadline))
            self._socket.sendall(command.encode() + b"\n")
            self._traffic.sent(command)
            reply = self._line(deadline)
            self._traffic.received(reply)
            return reply
        except TimeoutError as error:
            self._drop()
            raise DeadlineError(
                self._name, f"the dashboard server did not answer '{command}' within {self._timeout:g} s"
            ) from error
        except OSError as error:
            self._drop()
            raise NotConnectedError(
                self._name,
                f"the dashboard server at {self._address}:{PORT} is not reachable: {error}. "
                "See that the arm is switched on and that its address is right.",
            ) from error
        finally:
            self._lock.release()

    def close(self) -> None:
        """Close the connection; the next `ask` opens a new one."""
        with self._lock:
            self._drop()

    def _connect(self, deadline: float) -> None:
        self._socket = socket.create_connection((self._address, PORT), timeout=_left(deadline))
        self._rest = b""
        self._line(deadline)

    def _line(self, deadline: float) -> str:
        assert self._socket is not None
        while b"\n" not in self._rest:
            self._socket.settimeout(_left(deadline))
            data = self._socket.recv(4096)
            if not data:
                raise ConnectionResetError("the server closed the connection")
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode("utf-8", "replace").strip()

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _left(deadline: float) -> float:
    left = deadline - time.monotonic()
    if left <= 0:
        raise TimeoutError
    return left
