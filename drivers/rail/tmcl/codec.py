"""TMCL's binary telegrams: nine bytes each way, summed to eight bits.

Source: the maker's TMCL firmware manual; docs/reference/protocols.md, section 2. Bytes only: no port, no units.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

TELEGRAM_BYTES = 9
STATUS_OK = 100
_BODY = struct.Struct(">BBBBi")
STATUS_TEXT = {
    1: "wrong checksum",
    2: "invalid command",
    3: "wrong type",
    4: "invalid value",
    5: "EEPROM locked",
    6: "command not available",
}
"""What a module says when it refuses a command."""


class TmclCommand(IntEnum):
    """Command numbers."""

    ROTATE_RIGHT = 1
    MOTOR_STOP = 3
    MOVE_TO = 4
    SET_AXIS = 5
    GET_AXIS = 6
    SET_GLOBAL = 9
    GET_GLOBAL = 10
    REFERENCE_SEARCH = 13
    FIRMWARE = 136


class Axis(IntEnum):
    """Axis parameters; positions in microsteps, velocities in pulses per second (TMCM-1241, TMCM-1260)."""

    TARGET_POSITION = 0
    POSITION = 1
    VELOCITY = 3
    MAX_VELOCITY = 4
    MAX_ACCELERATION = 5
    POSITION_REACHED = 8
    HOME_SWITCH = 9
    RIGHT_SWITCH = 10
    LEFT_SWITCH = 11
    RAMP_15 = 15
    RAMP_16 = 16
    MAX_DECELERATION = 17
    RAMP_18 = 18
    RAMP_19 = 19
    STOP_VELOCITY = 20
    MICROSTEP_RESOLUTION = 140
    REFERENCE_MODE = 193
    REFERENCE_SEARCH_SPEED = 194
    REFERENCE_SWITCH_SPEED = 195
    EXTENDED_ERRORS = 207
    DRIVER_ERRORS = 208
    REVERSE_SHAFT = 251
    UNIT_MODE = 255


class ReferenceSearch(IntEnum):
    """Types of the reference-search command."""

    START = 0
    STOP = 1
    STATUS = 2


class TelegramError(ValueError):
    """A reply that does not answer the request: wrong length, checksum, module address or command."""


@dataclass(frozen=True)
class TmclRequest:
    """One command to a module; `value` is a signed 32-bit number."""

    address: int
    command: int
    type: int
    motor: int
    value: int = 0

    def encode(self) -> bytes:
        """The nine bytes of the telegram; `ValueError` when a field does not fit."""
        try:
            body = _BODY.pack(self.address, self.command, self.type, self.motor, self.value)
        except struct.error as error:
            raise ValueError(f"{self} does not fit a TMCL telegram: {error}") from error
        return body + bytes([checksum(body)])


@dataclass(frozen=True)
class TmclReply:
    """One answer; `value` is a signed 32-bit number."""

    host: int
    module: int
    status: int
    command: int
    value: int


def checksum(body: bytes) -> int:
    """Sum of the bytes, modulo 256."""
    return sum(body) & 0xFF


def decode_reply(data: bytes, request: TmclRequest) -> TmclReply:
    """Read the answer to `request`.

    Raises `TelegramError` when `data` is not nine bytes, fails its checksum, or comes from another module or from
    another command: a late answer to an earlier question is not this one's.
    """
    if len(data) != TELEGRAM_BYTES:
        raise TelegramError(f"{len(data)} bytes instead of {TELEGRAM_BYTES}")
    if checksum(data[:-1]) != data[-1]:
        raise TelegramError(f"checksum 0x{data[-1]:02x} instead of 0x{checksum(data[:-1]):02x}")
    reply = TmclReply(*_BODY.unpack(data[:-1]))
    if reply.module != request.address:
        raise TelegramError(f"answer of module {reply.module} instead of {request.address}")
    if reply.command != request.command:
        raise TelegramError(f"answer to command {reply.command} instead of {request.command}")
    return reply


def decode_firmware(data: bytes) -> str:
    """The answer to `TmclCommand.FIRMWARE`, type 0: the host's address, then eight ASCII characters, no checksum."""
    text = data[1:]
    if len(data) != TELEGRAM_BYTES or not text.isascii() or not text.decode("ascii").isprintable():
        raise TelegramError(f"{data.hex(' ')} is not a firmware text")
    return text.decode("ascii").strip()
