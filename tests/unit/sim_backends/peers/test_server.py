"""What peers serve with: a client costs its own connection only, and nothing is left once a peer has stopped."""

import json
import socket
import struct
import threading
from collections.abc import Callable

import pytest
import serial

from sim_backends.peers.server import PAUSE_S, JsonLinesPeer, SerialServer, TcpServer

pytestmark = pytest.mark.wire


def echo(connection: socket.socket) -> None:
    while data := connection.recv(100):
        if data == b"fail":
            raise RuntimeError("an error of the peer")
        connection.sendall(data)


def test_who_vanishes_or_brings_an_error_about_costs_its_own_connection_only():
    server = TcpServer("echo", echo)
    server.start()
    place = (server.host, server.port)
    killed = socket.create_connection(place, timeout=2.0)
    killed.sendall(b"half")
    killed.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    killed.close()
    with socket.create_connection(place, timeout=2.0) as failed:
        failed.sendall(b"fail")
        assert failed.recv(100) == b""
    with socket.create_connection(place, timeout=2.0) as client:
        client.sendall(b"hello")
        assert client.recv(100) == b"hello"
        server.drop()
        assert client.recv(100) == b""
    server.stop()


def whole(data: bytes, write: Callable[[bytes], object]) -> bytes:
    """Requests of four bytes, repeated."""
    while len(data) >= 4:
        write(data[:4])
        data = data[4:]
    return data


def test_a_serial_line_serves_a_terminal_and_a_socket_and_forgets_half_a_request():
    before = set(threading.enumerate())
    server = SerialServer("line", whole, pty=True)
    server.start()
    for url in (server.url, server.pty):
        with serial.serial_for_url(url, timeout=2.0) as port:
            port.write(b"ab")
            port.flush()
            threading.Event().wait(4 * PAUSE_S)
            port.write(b"wxyz")
            assert port.read(4) == b"wxyz"
    with socket.create_connection(("127.0.0.1", int(server.url.rsplit(":", 1)[1])), timeout=2.0):
        server.stop()
    assert set(threading.enumerate()) == before


def test_a_wrong_line_of_json_is_refused_with_its_reason_and_the_connection_stays():
    peer = JsonLinesPeer("lines", {"tell": lambda request: {"first": request["rows"][0][0]}})
    peer.start()
    told = {
        b'{"op": "tell", "rows": [[]]}': "IndexError: list index out of range",
        b'{"op": "tell"}': "KeyError: 'rows'",
        b'{"op": "tell", "rows": 1}': "TypeError: 'int' object is not subscriptable",
        b'{"op": "dance"}': "unknown op 'dance'; known: tell",
        b'{"op": ["tell"]}': "unknown op ['tell']; known: tell",
        b"[]": 'a request is one line with a JSON object that has "op"',
    }
    with socket.create_connection((peer.host, peer.port), timeout=2.0) as client, client.makefile("rwb") as lines:
        for line in (*told, b'{"op": "tell", "rows": [[3]]}'):
            lines.write(line + b"\n")
            lines.flush()
            error = {"ok": False, "error": told[line]} if line in told else {"ok": True, "first": 3}
            assert json.loads(lines.readline()) == error
    peer.stop()
