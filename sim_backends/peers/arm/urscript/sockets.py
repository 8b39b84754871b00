"""URScript's socket commands: a program as a client of servers, here on loopback addresses only.

Reading waits from cycle to cycle and never blocks the controller. Source: the maker's script manual.
"""

import ipaddress
import math
import socket
import struct
from collections.abc import Callable, Generator
from contextlib import suppress
from typing import TypeAlias, TypeVar

from sim_backends.peers.arm.commands import CYCLE
from sim_backends.peers.arm.urscript.environment import Commands, Environment, List, Value, shown

_NAME = "socket_0"
_CONNECTING_S = 2.0
_MOST_NUMBERS = 30
"""What the controller reads at once."""
Result = TypeVar("Result")
_Reading: TypeAlias = Generator[None, None, Result]


class _Connections:
    """The open sockets of one program, by name, and what has come in over them."""

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self._open: dict[str, socket.socket] = {}
        self._received: dict[str, bytes] = {}

    def open(self, address: str, port: int, name: str) -> _Reading[bool]:
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

    def take(self, name: str, enough: Callable[[bytes], int], timeout: float) -> _Reading[bytes]:
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
    sockets = _Sockets(links)
    return {name: getattr(sockets, name) for name in vars(_Sockets) if name.startswith("socket_")}


class _Sockets:
    """Its public methods and their parameters have the names of scripts."""

    def __init__(self, links: _Connections) -> None:
        self._links = links

    def socket_open(self, address: str, port: int, socket_name: str = _NAME) -> _Reading[bool]:
        return (yield from self._links.open(address, port, socket_name))

    def socket_close(self, socket_name: str = _NAME) -> None:
        self._links.close(socket_name)

    def socket_send_string(self, text: Value, socket_name: str = _NAME) -> bool:
        return self._links.send(socket_name, shown(text).encode())

    def socket_send_line(self, text: Value, socket_name: str = _NAME) -> bool:
        return self.socket_send_string(shown(text) + "\n", socket_name)

    def socket_set_var(self, name: str, value: Value, socket_name: str = _NAME) -> bool:
        return self.socket_send_string(f"SET {name} {shown(value)}\n", socket_name)

    def socket_send_int(self, value: float, socket_name: str = _NAME) -> bool:
        return self._links.send(socket_name, struct.pack(">i", int(value)))

    def socket_send_byte(self, value: float, socket_name: str = _NAME) -> bool:
        return self._links.send(socket_name, bytes([int(value) & 255]))

    def socket_read_binary_integer(self, number: int, socket_name: str = _NAME, timeout: float = 2) -> _Reading[List]:
        return (yield from _numbers(self._links, socket_name, int(number), timeout, ">i"))

    def socket_read_byte_list(self, number: int, socket_name: str = _NAME, timeout: float = 2) -> _Reading[List]:
        return (yield from _numbers(self._links, socket_name, int(number), timeout, ">B"))

    def socket_read_ascii_float(self, number: int, socket_name: str = _NAME, timeout: float = 2) -> _Reading[List]:
        """Numbers in brackets: (1.0, 2.0)."""
        data = yield from self._links.take(socket_name, lambda data: data.find(b")") + 1, timeout)
        values = []
        with suppress(ValueError):
            values = [float(part) for part in data.decode("ascii", "replace").strip().strip("()").split(",")]
        values = values[: int(number)]
        return List([len(values), *values, *[math.nan] * (int(number) - len(values))])

    def socket_read_line(self, socket_name: str = _NAME, timeout: float = 2) -> _Reading[str]:
        line = yield from self._links.take(socket_name, lambda data: data.find(b"\n") + 1, timeout)
        return line.decode("utf-8", "replace").rstrip("\r\n")

    def socket_read_string(
        self, socket_name: str = _NAME, prefix: str = "", suffix: str = "", interpret_escape: bool = False,
        timeout: float = 2,
    ) -> _Reading[str]:  # fmt: skip
        def enough(data: bytes) -> int:
            if not suffix:
                return len(data)
            found = data.find(suffix.encode())
            return 0 if found < 0 else found + len(suffix)

        text = (yield from self._links.take(socket_name, enough, timeout)).decode("utf-8", "replace")
        after = text.partition(prefix)[2] if prefix else text
        return after.removesuffix(suffix) if suffix else after

    def socket_get_var(self, name: str, socket_name: str = _NAME) -> _Reading[int]:
        """The server answers a question for one of its variables with its name and a number."""
        self._links.send(socket_name, f"GET {name}\n".encode())
        words = (yield from self.socket_read_line(socket_name)).split()
        return int(words[-1]) if words else 0


def _numbers(links: _Connections, name: str, count: int, timeout: float, code: str) -> _Reading[List]:
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
