"""The simulated GigE Vision camera, spoken to by a client of a few lines written for this test."""

import socket
import struct
from collections.abc import Iterator

import numpy as np
import pytest

from sim_backends.clock import WorldClock
from sim_backends.models.camera import CameraSpec
from sim_backends.peers.camera import gigevision as g
from sim_backends.peers.camera.gige import GigePeer
from tests.support import until

pytestmark = pytest.mark.wire
SPEC = CameraSpec("SimCam", "SIM000007-SCAN", 64, 48, frame_rate_max=120.0)


@pytest.fixture
def peer() -> Iterator[GigePeer]:
    made = GigePeer("scan", WorldClock(), lambda t, exposure: np.full((48, 64), 100, np.uint8), SPEC)
    made.start()
    yield made
    made.stop()


class Client:
    """Asks on a socket of its own, which pictures come to as well."""

    def __init__(self, peer: GigePeer) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(3.0)
        self.socket.bind(("127.0.0.1", 0))
        self._place = (peer.address, 3956)
        self._count = 0

    def ask(self, command: int, data: bytes) -> tuple[int, bytes]:
        """Status and data of the answer."""
        self._count += 1
        self.socket.sendto(struct.pack(">BBHHH", 0x42, 1, command, len(data), self._count) + data, self._place)
        while True:
            status, answered, size, number = struct.unpack_from(">HHHH", packet := self.socket.recv(10_000))
            if (answered, number) == (command + 1, self._count) and size == len(packet) - 8:
                return status, packet[8:]

    def write(self, address: int, value: int) -> int:
        return self.ask(0x82, struct.pack(">II", address, value))[0]

    def read(self, address: int) -> int:
        return int(struct.unpack(">I", self.ask(0x80, struct.pack(">I", address))[1])[0])


def test_one_client_controls_it_and_loses_control_when_it_falls_silent(peer: GigePeer):
    first, second = Client(peer), Client(peer)
    assert first.write(g.WIDTH, 32) == 0x8006, "nobody controls it yet"
    assert first.write(g.CONTROL, 2) == first.write(g.HEARTBEAT, 500) == first.write(g.WIDTH, 32) == 0
    assert (second.write(g.WIDTH, 16), second.read(g.WIDTH)) == (0x8006, 32)
    assert first.ask(0x99, b"")[0] == 0x8001
    assert until(lambda: not second.read(g.CONTROL), 5.0)
    assert second.write(g.CONTROL, 2) == 0


def test_a_picture_comes_to_where_it_is_told_and_its_packets_again(peer: GigePeer):
    client = Client(peer)
    port = client.socket.getsockname()[1]
    for address, value in ((g.CONTROL, 2), (g.PACKET_SIZE, 576), (g.STREAM_ADDRESS, 0x7F000001), (g.STREAM_PORT, port)):
        assert client.write(address, value) == 0
    assert client.write(g.TRIGGER_MODE, 1) == client.write(g.ACQUISITION, 1) == client.write(g.TRIGGER_SOFTWARE, 1) == 0
    made = [client.socket.recv(10_000)]
    while made[-1][4] != 2:
        made.append(client.socket.recv(10_000))
    assert b"".join(packet[8:] for packet in made if packet[4] == 3) == b"\x64" * (64 * 48)
    client.socket.sendto(struct.pack(">BBHHHHHII", 0x42, 0, 0x40, 12, 99, 0, 1, 2, 2), (peer.address, 3956))
    assert client.socket.recv(10_000) == made[2]
