"""The objects of a drive that are used, by their numbers in CiA 301 and CiA 402, and how their values are packed."""

from __future__ import annotations

import struct
from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """One value of the object dictionary; `form` as of `struct`, little endian."""

    index: int
    sub: int
    form: str
    name: str

    def __str__(self) -> str:
        part = f":{self.sub:02X}" if self.sub else ""
        return f"{self.index:04X}h{part} ({self.name})"

    @property
    def bits(self) -> int:
        """Its length."""
        return 8 * struct.calcsize(self.form)

    @property
    def mapping(self) -> int:
        """How a PDO's mapping names it."""
        return self.index << 16 | self.sub << 8 | self.bits

    def pack(self, value: int) -> bytes:
        """The value as it goes over the bus; `struct.error` when it does not fit."""
        return struct.pack(self.form, value)

    def unpack(self, data: bytes) -> int:
        """The value from the bus; some drives send more bytes than it has. `struct.error` when there are too few."""
        return int(struct.unpack_from(self.form, data)[0])


DEVICE_TYPE = Entry(0x1000, 0, "<I", "device type")
ERROR_REGISTER = Entry(0x1001, 0, "<B", "error register")
DEVICE_NAME, SOFTWARE = (0x1008, 0), (0x100A, 0)
"""Texts."""
GUARD_TIME = Entry(0x100C, 0, "<H", "guard time")
LIFE_FACTOR = Entry(0x100D, 0, "<B", "life time factor")
CONSUMER_HEARTBEAT = Entry(0x1016, 1, "<I", "consumer heartbeat time")
PRODUCER_HEARTBEAT = Entry(0x1017, 0, "<H", "producer heartbeat time")
VENDOR = Entry(0x1018, 1, "<I", "vendor")
PRODUCT = Entry(0x1018, 2, "<I", "product")
SERIAL = Entry(0x1018, 4, "<I", "serial number")
COMMUNICATION_ERROR = Entry(0x1029, 1, "<B", "behaviour on a communication error")

ABORT_CONNECTION = Entry(0x6007, 0, "<h", "abort connection option code")
ERROR_CODE = Entry(0x603F, 0, "<H", "error code")
CONTROLWORD = Entry(0x6040, 0, "<H", "controlword")
STATUSWORD = Entry(0x6041, 0, "<H", "statusword")
QUICK_STOP_OPTION = Entry(0x605A, 0, "<h", "quick stop option code")
HALT_OPTION = Entry(0x605D, 0, "<h", "halt option code")
FAULT_REACTION = Entry(0x605E, 0, "<h", "fault reaction option code")
MODE = Entry(0x6060, 0, "<b", "modes of operation")
MODE_DISPLAY = Entry(0x6061, 0, "<b", "modes of operation display")
POSITION = Entry(0x6064, 0, "<i", "position actual value")
VELOCITY = Entry(0x606C, 0, "<i", "velocity actual value")
DC_LINK = Entry(0x6079, 0, "<I", "DC link circuit voltage")
ACCELERATION = Entry(0x6083, 0, "<I", "profile acceleration")
DECELERATION = Entry(0x6084, 0, "<I", "profile deceleration")
QUICK_STOP_DECELERATION = Entry(0x6085, 0, "<I", "quick stop deceleration")
ENCODER_INCREMENTS = Entry(0x608F, 1, "<I", "position encoder resolution, increments")
ENCODER_TURNS = Entry(0x608F, 2, "<I", "position encoder resolution, motor turns")
VELOCITY_UNIT = Entry(0x60A9, 0, "<I", "SI unit velocity")
INPUTS = Entry(0x60FD, 0, "<I", "digital inputs")
OUTPUTS = Entry(0x60FE, 1, "<I", "digital outputs")
OUTPUT_MASK = Entry(0x60FE, 2, "<I", "digital outputs, mask")
TARGET_VELOCITY = Entry(0x60FF, 0, "<i", "target velocity")
SUPPORTED_MODES = Entry(0x6502, 0, "<I", "supported drive modes")

DRIVE_PROFILE = 402
"""Lower half of the device type."""
PROFILE_VELOCITY = 3
PROFILE_VELOCITY_BIT = 1 << 2
"""Of the supported drive modes."""

NMT, SYNC = 0x000, 0x080
EMERGENCY, STATUS, MOTION, HEALTH = 0x080, 0x180, 0x280, 0x380
COMMAND, SDO_REPLY, SDO_REQUEST, HEARTBEAT = 0x200, 0x580, 0x600, 0x700
"""Identifiers of the predefined connection set, to which a node's number is added. `STATUS`, `MOTION` and `HEALTH` are
the first three PDOs that a drive sends, `COMMAND` the first that it takes."""
START, PRE_OPERATIONAL = 0x01, 0x80
"""NMT commands."""
BOOTED, STOPPED, OPERATIONAL, PREPARING = 0x00, 0x04, 0x05, 0x7F
"""NMT states in a heartbeat."""
NMT_STATES = {BOOTED: "booted", STOPPED: "stopped", OPERATIONAL: "operational", PREPARING: "pre-operational"}
