"""One CANopen node without its bus: what a master reads, writes and maps, and what happens when it stays away."""

import struct

import pytest

from sim_backends.peers.vehicle.canopen_node import PREPARING, CanopenNode, Value
from sim_backends.peers.vehicle.slcan import CanFrame

NODE = 5


class Bus:
    """The node, what it has sent, and how often it lost its master."""

    def __init__(self) -> None:
        self.sent: list[CanFrame] = []
        self.lost = 0
        values = {
            (0x6041, 0): Value("<H", 0x0250, mappable=True),
            (0x60FF, 0): Value("<i", writable=True, mappable=True),
        }
        self.node = CanopenNode(NODE, values, {(0x1008, 0): b"a name of 16 chr"}, self.sent.append, self._lose)

    def _lose(self) -> None:
        self.lost += 1

    def hear(self, identifier: int, data: bytes = b"", now: float = 0.0) -> list[CanFrame]:
        """What it says to a frame."""
        before = len(self.sent)
        self.node.receive(CanFrame(identifier, data), now)
        return self.sent[before:]

    def sdo(self, command: int, index: int, sub: int, value: int = 0) -> tuple[int, int]:
        """Command byte and number of the answer."""
        (answer,) = self.hear(0x600 + NODE, struct.pack("<BHBI", command, index, sub, value))
        return answer.data[0], struct.unpack_from("<I", answer.data, 4)[0]


@pytest.fixture
def bus() -> Bus:
    return Bus()


def test_values_are_read_written_and_refused_by_their_codes(bus: Bus):
    assert bus.sdo(0x40, 0x6041, 0) == (0x4B, 0x0250)
    assert bus.sdo(0x23, 0x60FF, 0, 1234)[0] == 0x60
    assert bus.sdo(0x40, 0x60FF, 0) == (0x43, 1234)
    for request, code in (
        ((0x40, 0x6099, 0), 0x06020000), ((0x40, 0x6041, 3), 0x06090011), ((0x2B, 0x6041, 0, 1), 0x06010002),
        ((0x2F, 0x60FF, 0, 1), 0x06070010), ((0xE0, 0x6041, 0), 0x05040001),
    ):  # fmt: skip
        assert bus.sdo(*request) == (0x80, code)


def test_a_master_whose_heartbeat_stays_away_is_lost_once(bus: Bus):
    assert bus.sdo(0x23, 0x1016, 1, 127 << 16 | 200)[0] == 0x60
    bus.hear(0x000, bytes([0x01, 0]))
    bus.node.tick(5.0)
    assert bus.lost == 0, "it was never there"
    bus.hear(0x700 + 127, b"\x05", now=5.0)
    bus.node.tick(5.19)
    assert bus.lost == 0
    bus.node.tick(5.21)
    bus.node.tick(6.0)
    assert (bus.lost, bus.node.state) == (1, PREPARING)
    assert bus.sent[-1] == CanFrame(0x080 + NODE, struct.pack("<HB5x", 0x8130, 0x11))
