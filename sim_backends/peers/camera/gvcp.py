"""GigE Vision's control and stream packets as a camera reads and writes them: bytes only.

Source: GigE Vision 1.2, sections "GVCP" and "GVSP"; all numbers are big-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

PORT = 3956
"""Where every GigE Vision camera is asked."""
_KEY = 0x42
_COMMAND = struct.Struct(">BBHHH")
_REPLY = struct.Struct(">HHHH")
_ACKNOWLEDGE = 0x01
_IP_UDP_GVSP = 20 + 8 + 8
"""Bytes of a stream packet that are no pixels; a packet's size counts all of them."""
_LEADER, _TRAILER, _PAYLOAD = 1, 2, 3
_IMAGE = 1


class GvcpCommand(IntEnum):
    """What is asked; the answer's number is one more."""

    DISCOVERY = 0x02
    RESEND = 0x40
    READ_REGISTERS = 0x80
    WRITE_REGISTERS = 0x82
    READ_MEMORY = 0x84
    WRITE_MEMORY = 0x86


class GvcpStatus(IntEnum):
    """How an answer begins."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    ACCESS_DENIED = 0x8006


class GvcpRefused(Exception):
    """A request that is answered with an error."""

    def __init__(self, status: GvcpStatus) -> None:
        super().__init__(status.name)
        self.status = status


@dataclass(frozen=True)
class GvcpRequest:
    """A request: its command, data, id, and whether it is to be answered."""

    command: int
    data: bytes
    request_id: int
    answered: bool

    @classmethod
    def of(cls, packet: bytes) -> GvcpRequest | None:
        """None for bytes that are no request."""
        if len(packet) < _COMMAND.size:
            return None
        key, flags, command, length, request_id = _COMMAND.unpack_from(packet)
        data = packet[_COMMAND.size :]
        if key != _KEY or length != len(data):
            return None
        return cls(command, data, request_id, bool(flags & _ACKNOWLEDGE))

    def reply(self, data: bytes = b"", status: GvcpStatus = GvcpStatus.SUCCESS) -> bytes:
        """The answer's bytes."""
        return _REPLY.pack(status, self.command + 1, len(data), self.request_id) + data

    def words(self) -> tuple[int, ...]:
        """The data as 32-bit numbers; `GvcpRefused` when they are not whole."""
        if not self.data or len(self.data) % 4:
            raise GvcpRefused(GvcpStatus.INVALID_PARAMETER)
        return struct.unpack(f">{len(self.data) // 4}I", self.data)


@dataclass(frozen=True)
class Leader:
    """What comes before a picture's pixels; `timestamp` in ticks of the device's clock."""

    timestamp: int
    pixel_format: int
    width: int
    height: int
    left: int
    top: int


def packets(block_id: int, leader: Leader, pixels: bytes, packet_size: int) -> Iterator[bytes]:
    """A picture's packets in order: leader, pixels, trailer."""
    window = leader.width, leader.height, leader.left, leader.top
    head = struct.pack(">HHQIIIIIHH", 0, _IMAGE, leader.timestamp, leader.pixel_format, *window, 0, 0)
    yield _packet(block_id, _LEADER, 0, head)
    room = packet_size - _IP_UDP_GVSP
    number = 0
    for number, start in enumerate(range(0, len(pixels), room), 1):
        yield _packet(block_id, _PAYLOAD, number, pixels[start : start + room])
    yield _packet(block_id, _TRAILER, number + 1, struct.pack(">HHI", 0, _IMAGE, leader.height))


def test_packet(packet_size: int) -> bytes:
    """A packet that only shows whether packets of this size arrive."""
    return _packet(0, _PAYLOAD, 0, bytes(packet_size - _IP_UDP_GVSP))


def _packet(block_id: int, kind: int, number: int, data: bytes) -> bytes:
    return struct.pack(">HHI", 0, block_id, kind << 24 | number) + data
