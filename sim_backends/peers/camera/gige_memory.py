"""What can be read and written in a GigE Vision camera: the standard's registers, its own, and their description.

Source: GigE Vision 1.2, "bootstrap registers". All numbers are big-endian; the description (GenICam XML) tells a client
where each feature is.
"""

from __future__ import annotations

import math
import socket
import struct

from sim_backends.models.camera import CameraSpec
from sim_backends.peers.camera.gige_description import describe
from sim_backends.peers.camera.gige_pixels import ENCODERS
from sim_backends.peers.camera.gige_registers import (
    ACQUISITION,
    ACQUISITION_MODE,
    CONTROL,
    EXPOSURE,
    FRAME_RATE,
    GAIN,
    GAINS_DB,
    HEARTBEAT,
    HEIGHT,
    LEFT,
    LINE,
    PACKET_DELAY,
    PACKET_SIZE,
    PACKET_SIZES,
    PAYLOAD,
    PIXEL_FORMAT,
    SLOWEST_HZ,
    SOFTWARE,
    STREAM_ADDRESS,
    STREAM_PORT,
    TIMESTAMP,
    TIMESTAMP_CONTROL,
    TOP,
    TRIGGER_ACTIVATION,
    TRIGGER_MODE,
    TRIGGER_SOFTWARE,
    TRIGGER_SOURCE,
    WIDTH,
)
from sim_backends.peers.camera.gvcp import GvcpRefused, GvcpStatus

_DESCRIPTION = 0x20000
_TICKS_PER_SECOND = 10**9
_WRITABLE_WORDS = frozenset((
    CONTROL, HEARTBEAT, TIMESTAMP_CONTROL, STREAM_PORT, PACKET_SIZE, PACKET_DELAY, STREAM_ADDRESS, WIDTH, HEIGHT,
    LEFT, TOP, PIXEL_FORMAT, ACQUISITION, ACQUISITION_MODE, TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER_ACTIVATION,
    TRIGGER_SOFTWARE,
))  # fmt: skip


class GigeMemory:
    """The memory of one camera at the address `host`."""

    def __init__(self, spec: CameraSpec, host: str) -> None:
        self.spec = spec
        self._reals = {
            EXPOSURE: (1e6 * spec.exposure_min, 1e6 * spec.exposure_max),
            FRAME_RATE: (SLOWEST_HZ, spec.frame_rate_max),
            GAIN: GAINS_DB,
        }
        text = describe(spec, self._reals).encode()
        self._bytes = bytearray(_DESCRIPTION) + text
        for address, value in (
            (0x0000, 0x00010002), (0x0004, 0x80000001), (0x0010, 0x80000007), (0x0014, 0x5), (0x0600, 1), (0x0904, 1),
            (0x0934, 0x6), (HEARTBEAT, 3000), (0x0940, _TICKS_PER_SECOND), (PACKET_SIZE, 1500), (WIDTH, spec.width),
            (HEIGHT, spec.height), (PIXEL_FORMAT, 0x01080001), (0x0024, _number(host)),
        ):  # fmt: skip
            self.set_word(address, value)
        for address, size, word in (
            (0x0048, 32, "simulated"), (0x0068, 32, spec.model), (0x0088, 32, spec.firmware), (0x00D8, 16, spec.serial),
            (0x0200, 512, f"Local:camera.xml;{_DESCRIPTION:X};{len(text):X}"),
        ):  # fmt: skip
            self._bytes[address : address + size] = word.encode()[: size - 1].ljust(size, b"\0")
        for address, real in ((EXPOSURE, 2000.0), (FRAME_RATE, min(10.0, spec.frame_rate_max)), (GAIN, 0.0)):
            self._bytes[address : address + 8] = struct.pack(">d", real)
        self._count_payload()

    def read(self, address: int, size: int) -> bytes:
        """`size` bytes from `address`; `GvcpRefused` outside the memory."""
        if address % 4 or address + size > len(self._bytes) + 3:
            raise GvcpRefused(GvcpStatus.INVALID_ADDRESS)
        return bytes(self._bytes[address : address + size]).ljust(size, b"\0")

    def word(self, address: int) -> int:
        """A register of 32 bits."""
        value: int = struct.unpack(">I", self.read(address, 4))[0]
        return value

    def real(self, address: int) -> float:
        """A register that holds a real number."""
        value: float = struct.unpack(">d", self.read(address, 8))[0]
        return value

    def set_word(self, address: int, value: int) -> None:
        """Put a number of 32 bits there, as the camera itself does."""
        self._bytes[address : address + 4] = struct.pack(">I", value)

    def set_time(self, ticks: int) -> None:
        """The latched time."""
        self._bytes[TIMESTAMP : TIMESTAMP + 8] = struct.pack(">Q", ticks)

    def write(self, address: int, data: bytes) -> None:
        """What a client writes; `GvcpRefused` where it may not, or not this value."""
        if address in self._reals and len(data) == 8:
            low, high = self._reals[address]
            value = struct.unpack(">d", data)[0]
            if not (math.isfinite(value) and low * (1 - 1e-9) <= value <= high * (1 + 1e-9)):
                raise GvcpRefused(GvcpStatus.INVALID_PARAMETER)
        elif address in _WRITABLE_WORDS and len(data) == 4:
            self._check_word(address, struct.unpack(">I", data)[0])
        else:
            raise GvcpRefused(GvcpStatus.WRITE_PROTECT)
        self._bytes[address : address + len(data)] = data
        self._count_payload()

    def _check_word(self, address: int, value: int) -> None:
        room = {
            WIDTH: (16, self.spec.width - self.word(LEFT)),
            HEIGHT: (16, self.spec.height - self.word(TOP)),
            LEFT: (0, self.spec.width - self.word(WIDTH)),
            TOP: (0, self.spec.height - self.word(HEIGHT)),
            TRIGGER_SOURCE: (SOFTWARE, LINE),
            HEARTBEAT: (500, 60_000),
        }
        low, high = room.get(address, (0, 0xFFFFFFFF))
        known = address != PIXEL_FORMAT or value in ENCODERS
        if address == PACKET_SIZE:
            known = PACKET_SIZES[0] <= value & 0xFFFF <= PACKET_SIZES[1]
        if not (known and low <= value <= high):
            raise GvcpRefused(GvcpStatus.INVALID_PARAMETER)

    def _count_payload(self) -> None:
        bits = ENCODERS[self.word(PIXEL_FORMAT)][1]
        self.set_word(PAYLOAD, -(-self.word(WIDTH) * self.word(HEIGHT) * bits // 8))


def _number(host: str) -> int:
    value: int = struct.unpack(">I", socket.inet_aton(host))[0]
    return value
