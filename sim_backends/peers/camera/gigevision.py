"""What a GigE Vision camera says and keeps: control and stream packets, registers, pixel formats, its description.

Bytes only, all numbers big-endian. Sources: GigE Vision 1.2, "GVCP", "GVSP" and "bootstrap registers"; its own ones are
from 0x10000 on. Pixel Format Naming Convention 2.1, 10 and 12 bits being the grey's 8 with noughts below. GenICam 2.1
(schema 1.1) and Standard Features Naming Convention 2.4 for the description.
"""

import math
import socket
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sim_backends.models.camera import CameraSpec

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
    def of(cls, packet: bytes) -> "GvcpRequest | None":
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


CONTROL = 0x0A00
CONTROLLER_PORT, CONTROLLER_ADDRESS = 0x0A10, 0x0A14
HEARTBEAT = 0x0938
TIMESTAMP_CONTROL, TIMESTAMP = 0x0944, 0x0948
STREAM_PORT, PACKET_SIZE, PACKET_DELAY, STREAM_ADDRESS = 0x0D00, 0x0D04, 0x0D08, 0x0D18

WIDTH, HEIGHT, LEFT, TOP, PIXEL_FORMAT = 0x10000, 0x10004, 0x10008, 0x1000C, 0x10010
ACQUISITION, ACQUISITION_MODE = 0x10020, 0x10024
TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER_ACTIVATION, TRIGGER_SOFTWARE = 0x10030, 0x10034, 0x10038, 0x1003C
EXPOSURE, FRAME_RATE, GAIN, PAYLOAD = 0x10040, 0x10048, 0x10050, 0x10060

SOFTWARE, LINE = 0, 1
PACKET_SIZES = (576, 9000)
GAINS_DB = (0.0, 24.0)
SLOWEST_HZ = 0.01


Grey = NDArray[np.uint8]


def _plain(image: Grey) -> bytes:
    return image.tobytes()


def _words(bits: int) -> Callable[[Grey], bytes]:
    return lambda image: (image.astype("<u2") << (bits - 8)).tobytes()


def _packed(bits: int) -> Callable[[Grey], bytes]:
    """Two pixels in three bytes: high bits of the first, low ones of both, high bits of the second."""

    def encode(image: Grey) -> bytes:
        values = _pairs(image, 2).astype(np.uint16) << (bits - 8)
        low = (1 << (bits - 8)) - 1
        middle = ((values[:, 1] & low) << 4) | (values[:, 0] & low)
        return np.stack([values[:, 0] >> (bits - 8), middle, values[:, 1] >> (bits - 8)], 1).astype(np.uint8).tobytes()

    return encode


def _stream_of_bits(bits: int) -> Callable[[Grey], bytes]:
    """Pixels one after the other, the lowest bit first."""

    def encode(image: Grey) -> bytes:
        values = _pairs(image, 4).reshape(-1).astype(np.uint16) << (bits - 8)
        each = (values[:, None] >> np.arange(bits)) & 1
        return np.packbits(each.astype(np.uint8).reshape(-1), bitorder="little").tobytes()

    return encode


def _triple(image: Grey) -> bytes:
    return np.repeat(image.reshape(-1), 3).tobytes()


def _pairs(image: Grey, group: int) -> Grey:
    flat = image.reshape(-1)
    return np.concatenate([flat, np.zeros(-len(flat) % group, np.uint8)]).reshape(-1, group)


ENCODERS: dict[int, tuple[str, int, Callable[[Grey], bytes]]] = {
    0x01080001: ("Mono8", 8, _plain), 0x01100003: ("Mono10", 16, _words(10)),
    0x010C0004: ("Mono10Packed", 12, _packed(10)), 0x010A0046: ("Mono10p", 10, _stream_of_bits(10)),
    0x01100005: ("Mono12", 16, _words(12)), 0x010C0006: ("Mono12Packed", 12, _packed(12)),
    0x010C0047: ("Mono12p", 12, _stream_of_bits(12)), 0x01080009: ("BayerRG8", 8, _plain),
    0x02180014: ("RGB8", 24, _triple),
}  # fmt: skip
"""Format's number → name, bits a pixel, and its bytes from a grey picture."""


_TEXTS = (
    ("DeviceVendorName", 0x48, 32), ("DeviceModelName", 0x68, 32), ("DeviceVersion", 0x88, 32),
    ("DeviceSerialNumber", 0xD8, 16),
)  # fmt: skip
_CHOICES: tuple[tuple[str, int, dict[str, int]], ...] = (
    ("PixelFormat", PIXEL_FORMAT, {name: code for code, (name, _, _) in ENCODERS.items()}),
    ("AcquisitionMode", ACQUISITION_MODE, {"Continuous": 0}),
    ("TriggerMode", TRIGGER_MODE, {"Off": 0, "On": 1}),
    ("TriggerSource", TRIGGER_SOURCE, {"Software": SOFTWARE, "Line1": LINE}),
    ("TriggerActivation", TRIGGER_ACTIVATION, {"RisingEdge": 0, "FallingEdge": 1}),
)
_COMMANDS = (
    ("AcquisitionStart", ACQUISITION, 1), ("AcquisitionStop", ACQUISITION, 0),
    ("TriggerSoftware", TRIGGER_SOFTWARE, 1), ("GevSCPSFireTestPacket", PACKET_SIZE, None),
)  # fmt: skip
_UNITS = {EXPOSURE: ("ExposureTime", "us"), FRAME_RATE: ("AcquisitionFrameRate", "Hz"), GAIN: ("Gain", "dB")}
_FIXED = (
    '<Enumeration Name="TriggerSelector"><EnumEntry Name="FrameStart"><Value>0</Value></EnumEntry><Value>0</Value>'
    '</Enumeration><Integer Name="TLParamsLocked"><Value>0</Value><Min>0</Min><Max>1</Max></Integer>'
)
_HEAD = (
    '<?xml version="1.0" encoding="utf-8"?><RegisterDescription ModelName="SimulatedCamera" '
    'VendorName="simulated" StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" '
    'SchemaSubMinorVersion="0" MajorVersion="1" '
    'MinorVersion="0" SubMinorVersion="0" ProductGuid="0" VersionGuid="0" '
    'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
)


def describe(spec: CameraSpec, reals: dict[int, tuple[float, float]]) -> str:
    """The camera's description, a GenICam XML of schema 1.1; `reals` are least and most of its real registers."""
    words = (
        ("Width", WIDTH, 16, spec.width, 1), ("Height", HEIGHT, 16, spec.height, 1),
        ("OffsetX", LEFT, 0, spec.width, 1), ("OffsetY", TOP, 0, spec.height, 1),
        ("PayloadSize", PAYLOAD, 0, 2**31, 1),
        ("GevSCPSPacketSize", PACKET_SIZE, *PACKET_SIZES, 4), ("GevSCPD", PACKET_DELAY, 0, 2**31, 1),
    )  # fmt: skip
    nodes = [_integer(name, address, (low, high, step)) for name, address, low, high, step in words]
    nodes += [_register("StringReg", name, address, size) for name, address, size in _TEXTS]
    nodes += [_choice(name, address, entries) for name, address, entries in _CHOICES]
    nodes.append(_FIXED)
    nodes += [_command(name, address, value) for name, address, value in _COMMANDS]
    nodes += [_real(name, unit, address, reals[address]) for address, (name, unit) in _UNITS.items()]
    names = "".join(f"<pFeature>{name}</pFeature>" for name in (w[0] for w in (*words, *_TEXTS, *_CHOICES)))
    return f'{_HEAD}<Category Name="Root">{names}</Category>{"".join(nodes)}<Port Name="Device"/></RegisterDescription>'


def _integer(name: str, address: int, limits: tuple[int, int, int]) -> str:
    low, high, step = limits
    mask = "<LSB>31</LSB><MSB>16</MSB>" if name == "GevSCPSPacketSize" else ""
    kind = "MaskedIntReg" if mask else "IntReg"
    return (
        f'<Integer Name="{name}"><pValue>{name}Reg</pValue><Min>{low}</Min><Max>{high}</Max><Inc>{step}</Inc>'
        "</Integer>"
        f"{_register(kind, f'{name}Reg', address, 4, mask)}"
    )


def _choice(name: str, address: int, entries: dict[str, int]) -> str:
    listed = "".join(
        f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>' for entry, value in entries.items()
    )
    return (
        f'<Enumeration Name="{name}">{listed}<pValue>{name}Reg</pValue></Enumeration>'
        f"{_register('IntReg', f'{name}Reg', address, 4)}"
    )


def _command(name: str, address: int, value: int | None) -> str:
    """What writes `value`; None for one bit of a register that is for something else."""
    if value is None:
        register = _register("MaskedIntReg", f"{name}Reg", address, 4, "<LSB>0</LSB><MSB>0</MSB>")
    else:
        register = _register("IntReg", f"{name}Reg", address, 4)
    shown = 1 if value is None else value
    return f'<Command Name="{name}"><pValue>{name}Reg</pValue><CommandValue>{shown}</CommandValue></Command>{register}'


def _real(name: str, unit: str, address: int, limits: tuple[float, float]) -> str:
    least, most = limits
    return (
        f'<Float Name="{name}"><pValue>{name}Reg</pValue><Min>{least!r}</Min><Max>{most!r}</Max>'
        f"<Unit>{unit}</Unit></Float>"
        f"{_register('FloatReg', f'{name}Reg', address, 8)}"
    )


def _register(kind: str, name: str, address: int, length: int, more: str = "") -> str:
    sign = "<Sign>Unsigned</Sign>" if kind in ("IntReg", "MaskedIntReg") else ""
    endian = "" if kind == "StringReg" else "<Endianess>BigEndian</Endianess>"
    return (
        f'<{kind} Name="{name}"><Address>0x{address:X}</Address><Length>{length}</Length><AccessMode>RW</AccessMode>'
        f"<pPort>Device</pPort><Cachable>NoCache</Cachable>{more}{sign}{endian}</{kind}>"
    )


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
            WIDTH: (16, self.spec.width - self.word(LEFT)), HEIGHT: (16, self.spec.height - self.word(TOP)),
            LEFT: (0, self.spec.width - self.word(WIDTH)), TOP: (0, self.spec.height - self.word(HEIGHT)),
            TRIGGER_SOURCE: (SOFTWARE, LINE), HEARTBEAT: (500, 60_000),
        }  # fmt: skip
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
