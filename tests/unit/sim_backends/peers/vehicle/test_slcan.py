"""The adapters of the simulated bus, spoken to directly and through python-can."""

import socket
from collections.abc import Iterator

import can
import pytest

from sim_backends.peers.vehicle.agilex import AgilexPeer
from tests.support.simulator.can_bus import message, open_bus, receive

pytestmark = pytest.mark.wire


@pytest.fixture
def adapter(peer: AgilexPeer) -> Iterator[socket.socket]:
    host, port = peer.channel.removeprefix("socket://").split(":")
    with socket.create_connection((host, int(port)), timeout=2.0) as adapter:
        yield adapter


def ask(adapter: socket.socket, line: bytes) -> bytes:
    adapter.sendall(line + b"\r")
    answer = b""
    while not answer.endswith((b"\r", b"\a")):
        answer += adapter.recv(1)
    return answer


def test_all_clients_share_the_bus(peer: AgilexPeer, bus: can.BusABC):
    other = open_bus(peer)
    receive(other, lambda f: True)
    bus.send(message(0x7AB, [1, 2, 3]))
    assert receive(other, lambda f: f.arbitration_id == 0x7AB).data == b"\x01\x02\x03"
    other.shutdown()


def test_an_adapter_answers_as_the_lawicel_protocol_says(adapter: socket.socket, peer: AgilexPeer):
    assert (ask(adapter, b"V"), ask(adapter, b"N"), ask(adapter, b"t1110")) == (b"V1013\r", b"NSIM1\r", b"\a")
    assert (ask(adapter, b"S5"), ask(adapter, b"O"), ask(adapter, b"O")) == (b"\r", b"\r", b"\a")
    assert (ask(adapter, b"t1110"), ask(adapter, b"F"), ask(adapter, b"C")) == (b"\a", b"F84\r", b"\r")
    assert ask(adapter, b"S6") == b"\r"
    for malformed in (b"t11", b"t8000", b"t1119", b"t1112AA", b"tXYZ0", b"S9", b"Q", b"\xff\xfe"):
        assert ask(adapter, malformed) == b"\a"
