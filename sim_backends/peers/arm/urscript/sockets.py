"""URScript's socket commands: a program as a client of servers, here on loopback addresses only.

Reading waits from cycle to cycle and never blocks the controller. Source: the maker's script manual.
"""

from __future__ import annotations

import ipaddress
import math
import socket
import struct
from collections.abc import Callable, Generator
from contextlib import suppress

from sim_backends.peers.arm.commands import CYCLE
from sim_backends.peers.arm.urscript.environment import Commands, Environment, List, Value, shown

_NAME = "socket_0"
_CONNECTING_S = 2.0
_MOST_NUMBERS = 30
"""What the controller reads at once."""


class _Connections:
    """The open sockets of one program, by name, and what has come in over them."""

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self._open: dict[str, socket.socket] = {}
        self._received: dict[str, bytes] = {}

    def open(self, address: str, port: int, name: str) -> Generator[None, None, bool]:
        self.close(name)
        if not _is_loopback(address):
            return False
        connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        connection.setblocking(False)
        for _ in range(round(_CONNECTING_S / CYCLE)):
            code = connection.connect_ex((address, int(port)))
            if code in (0, 106):  # EISCONN: it came about in a cycle before
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._open[name], self._received[name] = connection, b""
                return True
            if code not in (114, 115):  # EALREADY, EINPROGRESS
                break
            yield
        connection.close()
        return False

    def close(self, name: str) -> None:
        connection = self._open.pop(name, None)
        if connection is not None:
            connection.close()

    def close_all(self) -> None:
        for name in list(self._open):
            self.close(name)

    def send(self, name: str, data: bytes) -> bool:
        connection = self._open.get(name)
        if connection is None:
            return False
        try:
            connection.sendall(data)
        except OSError:
            self.close(name)
            return False
        return True

    def take(self, name: str, enough: Callable[[bytes], int], timeout: float) -> Generator[None, None, bytes]:
        """The first `enough(received)` bytes as soon as that is not 0; none after `timeout` s (0: for ever)."""
        cycles = math.inf if timeout <= 0 else max(1, round(timeout / CYCLE))
        while True:
            self._receive(name)
            received = self._received.get(name, b"")
            if (count := enough(received)) and self._environment.may_read():
                self._received[name] = received[count:]
                return received[:count]
            cycles -= not self._environment.held_up
            if cycles < 0:
                return b""
            # A closed connection costs a cycle as well: a script that reads on must not keep the others waiting.
            yield
            if name not in self._open:
                return b""

    def _receive(self, name: str) -> None:
        connection = self._open.get(name)
        if connection is None:
            return
        try:
            data = connection.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._received[name] += data
        else:
            self.close(name)


def commands(environment: Environment) -> Commands:
    """By name; those that take time are generator functions."""
    links = _Connections(environment)
    environment.on_close(links.close_all)
    return {**_sending(links), **_reading_numbers(links), **_reading_text(links)}


def _sending(links: _Connections) -> Commands:
    """To open, to close and to send."""

    def socket_open(address: str, port: int, socket_name: str = _NAME) -> Generator[None, None, bool]:
        return (yield from links.open(address, port, socket_name))

    def send(text: Value, socket_name: str = _NAME) -> bool:
        return links.send(socket_name, shown(text).encode())

    return {
        "socket_open": socket_open,
        "socket_close": lambda socket_name=_NAME: links.close(socket_name),
        "socket_set_var": lambda name, value, socket_name=_NAME: send(f"SET {name} {shown(value)}\n", socket_name),
        "socket_send_string": send,
        "socket_send_line": lambda text, socket_name=_NAME: send(shown(text) + "\n", socket_name),
        "socket_send_int": lambda value, socket_name=_NAME: links.send(socket_name, struct.pack(">i", int(value))),
        "socket_send_byte": lambda value, socket_name=_NAME: links.send(socket_name, bytes([int(value) & 255])),
    }


def _reading_numbers(links: _Connections) -> Commands:
    """To read numbers."""

    def read_integers(number: int, socket_name: str = _NAME, timeout: float = 2) -> Generator[None, None, List]:
        return (yield from _numbers(links, socket_name, int(number), timeout, ">i"))

    def read_bytes(number: int, socket_name: str = _NAME, timeout: float = 2) -> Generator[None, None, List]:
        return (yield from _numbers(links, socket_name, int(number), timeout, ">B"))

    def read_floats(number: int, socket_name: str = _NAME, timeout: float = 2) -> Generator[None, None, List]:
        """Numbers in brackets: (1.0, 2.0)."""
        text = (yield from links.take(socket_name, lambda data: data.find(b")") + 1, timeout)).decode(
            "ascii", "replace"
        )
        values = []
        with suppress(ValueError):
            values = [float(part) for part in text.strip().strip("()").split(",")][: int(number)]
        return List([len(values), *values, *[math.nan] * (int(number) - len(values))])

    return {
        "socket_read_binary_integer": read_integers,
        "socket_read_byte_list": read_bytes,
        "socket_read_ascii_float": read_floats,
    }


def _reading_text(links: _Connections) -> Commands:
    """To read text, and to ask a server for one of its variables."""

    def read_line(socket_name: str = _NAME, timeout: float = 2) -> Generator[None, None, str]:
        line = yield from links.take(socket_name, lambda data: data.find(b"\n") + 1, timeout)
        return line.decode("utf-8", "replace").rstrip("\r\n")

    def read_string(
        socket_name: str = _NAME, prefix: str = "", suffix: str = "", interpret_escape: bool = False, timeout: float = 2
    ) -> Generator[None, None, str]:
        def enough(data: bytes) -> int:
            if not suffix:
                return len(data)
            found = data.find(suffix.encode())
            return 0 if found < 0 else found + len(suffix)

        text = (yield from links.take(socket_name, enough, timeout)).decode("utf-8", "replace")
        after = text.partition(prefix)[2] if prefix else text
        return after.removesuffix(suffix) if suffix else after

    def get_var(name: str, socket_name: str = _NAME) -> Generator[None, None, int]:
        """The server answers a question for one of its variables with its name and a number."""
        links.send(socket_name, f"GET {name}\n".encode())
        words = (yield from read_line(socket_name)).split()
        return int(words[-1]) if words else 0

    return {"socket_read_line": read_line, "socket_read_string": read_string, "socket_get_var": get_var}


def _numbers(links: _Connections, name: str, count: int, timeout: float, code: str) -> Generator[None, None, List]:
    """The count of what came, then the numbers; zeros and a count of 0 when they did not all come in time."""
    count = min(count, _MOST_NUMBERS)
    size = struct.calcsize(code) * count
    data = yield from links.take(name, lambda received: size if len(received) >= size else 0, timeout)
    if not data:
        return List([0] * (count + 1))
    return List([count, *(number for (number,) in struct.iter_unpack(code, data))])


def _is_loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"
