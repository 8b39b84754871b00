"""What one wheel drive has told last: its state by its statusword, its emergency code in words with a remedy.

Source: the error code ranges of CiA 301 and the codes that CiA 402 adds. A code that is not here is told by its range.

The objects of a drive that are used, by their numbers in CiA 301 and CiA 402, and how their values are packed."""

import math
import struct
from dataclasses import dataclass
from enum import Enum


class DriveState(Enum):
    """State of one drive; the value is its name for people."""

    NOT_READY = "not ready to switch on"
    DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    REACTING = "fault reaction active"
    FAULT = "fault"


VOLTAGE, WARNING, REMOTE = 1 << 4, 1 << 7, 1 << 9
"""Bits of the statusword: the power stage has voltage; a warning; the controlword is obeyed."""
DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE, FAULT_RESET = 0x00, 0x02, 0x06, 0x07, 0x0F, 0x80
"""Controlwords. `SWITCH_ON` also ends operation, to the state switched on."""
HALT = 1 << 8

_MASKED = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.DISABLED),
    (0x6F, 0x21, DriveState.READY),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP),
    (0x4F, 0x0F, DriveState.REACTING),
    (0x4F, 0x08, DriveState.FAULT),
)
_ENERGISED = (DriveState.ENABLED, DriveState.QUICK_STOP, DriveState.REACTING)


def state_of(statusword: int) -> DriveState:
    """The state; bits that fit none are those of a drive that is not ready."""
    return next((state for mask, bits, state in _MASKED if statusword & mask == bits), DriveState.NOT_READY)


def may_turn(state: DriveState) -> bool:
    """Whether the drive turns its motor in this state, or holds it; its own brake is then open."""
    return state in _ENERGISED


def leads_to_enabled(state: DriveState, last: int) -> int:
    """The controlword of the next step to `ENABLED`; `last` was sent before. A fault is reset by a rising edge."""
    match state:
        case DriveState.FAULT:
            return FAULT_RESET if last == DISABLE_VOLTAGE else DISABLE_VOLTAGE
        case DriveState.DISABLED:
            return SHUTDOWN
        case DriveState.READY:
            return SWITCH_ON
        case DriveState.SWITCHED_ON | DriveState.ENABLED:
            return ENABLE
        case _:
            return DISABLE_VOLTAGE


def leads_to_switched_on(state: DriveState, last: int) -> int:
    """The controlword of the next step to `SWITCHED_ON`, where the motor does not turn."""
    return SWITCH_ON if state in (DriveState.SWITCHED_ON, DriveState.ENABLED) else leads_to_enabled(state, last)


_CODES = {
    0x2310: ("the motor took too much current for too long", "see what the wheel runs against"),
    0x2320: ("short circuit or earth fault at the motor", "switch off and measure the motor's cable"),
    0x2330: ("earth fault at the motor", "switch off and measure the motor's cable"),
    0x3110: ("supply voltage too high", "check battery and charger"),
    0x3120: ("supply voltage too low", "charge the battery, check its fuse and the emergency stop's contactor"),
    0x3210: ("DC link voltage too high", "lower vehicle.deceleration, or fit a brake resistor"),
    0x3220: ("DC link voltage too low", "charge the battery, check its fuse and the emergency stop's contactor"),
    0x4210: ("the drive is too hot", "let the vehicle stand and see that the drive is cooled"),
    0x4310: ("the drive is too hot", "let the vehicle stand and see that the drive is cooled"),
    0x4410: ("the motor is too hot", "let the vehicle stand and see whether a brake drags"),
    0x5441: ("a safe stop contact is open", "release the emergency stop"),
    0x5442: ("a safe stop contact is open", "release the emergency stop"),
    0x6320: ("a parameter of the drive does not fit", "compare the drive's set-up with its maker's tool"),
    0x7121: ("the motor is blocked", "see what the wheel runs against and whether its brake opens"),
    0x7122: ("the motor's commutation fails", "check motor and encoder cables"),
    0x7305: ("the encoder fails", "check the encoder's cable"),
    0x7306: ("the second encoder fails", "check the encoder's cable"),
    0x8110: ("the drive lost CAN messages", "check the bus and its load"),
    0x8120: ("the drive's CAN controller is error passive", "measure 60 ohm between CAN high and low"),
    0x8130: ("our heartbeat stayed away", "see what keeps this computer busy, or raise vehicle.watchdog"),
    0x8140: ("the drive was off the CAN bus", "measure 60 ohm between CAN high and low"),
    0x8210: ("a PDO of another length came", "see whether another master commands the drive"),
    0x8220: ("a PDO of another length came", "see whether another master commands the drive"),
    0x8311: ("more torque than allowed was asked", "see what the wheel runs against"),
    0x8400: ("the velocity is not kept", "see what the wheel runs against and whether its brake opens"),
    0x8480: ("the wheel runs too fast", "compare velocity_unit, gear and counts_per_turn with the drive"),
    0x8611: ("following error", "see what the wheel runs against and whether its brake opens"),
}
_RANGES = (
    (0xFF00, 0x1000, "a fault without further words"),
    (0xF000, 0x2000, "current"),
    (0xF000, 0x3000, "voltage"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "the drive's hardware"),
    (0xF000, 0x6000, "the drive's software or parameters"),
    (0xF000, 0x7000, "a module of the drive, such as motor or encoder"),
    (0xFF00, 0x8100, "communication"),
    (0xF000, 0x8000, "monitoring"),
    (0xF000, 0x9000, "something outside of the drive"),
    (0xFF00, 0xFF00, "a fault of its maker's own"),
)


def meaning(code: int) -> str:
    """What the emergency `code` says and what to do."""
    if code in _CODES:
        words, remedy = _CODES[code]
        return f"{words}, {code:04X}h: {remedy}"
    words = next((words for mask, bits, words in _RANGES if code & mask == bits), "a code that no profile has")
    return f"{words}, {code:04X}h: see the drive's manual"


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

NMT, SYNC = 0x000, 0x080
EMERGENCY, STATUS, MOTION, HEALTH = 0x080, 0x180, 0x280, 0x380
COMMAND, SDO_REPLY, SDO_REQUEST, HEARTBEAT = 0x200, 0x580, 0x600, 0x700
"""Identifiers of the predefined connection set, to which a node's number is added. `STATUS`, `MOTION` and `HEALTH` are
the first three PDOs that a drive sends, `COMMAND` the first that it takes."""
START, PRE_OPERATIONAL = 0x01, 0x80
BOOTED, STOPPED, OPERATIONAL, PREPARING = 0x00, 0x04, 0x05, 0x7F
NMT_STATES = {BOOTED: "booted", STOPPED: "stopped", OPERATIONAL: "operational", PREPARING: "pre-operational"}


_KEPT = 4
"""Emergencies of which each is told."""


class SideDrive:
    """The drive of one side; filled through `take`, by whoever holds the lock. Times are host times in s."""

    def __init__(self, side: str, node: int) -> None:
        self.side = side
        self.node = node
        self.statusword = self.position = self.velocity = self.mode = self.inputs = self.code = 0
        self.millivolts: int | None = None
        self.told = self.moved = self.beaten = -math.inf
        """When status and position, velocity, and its heartbeat came last."""
        self.nmt: int | None = None
        self.emergencies: list[int] = []
        """Codes since its last fault was reset."""
        self.configured = False
        """Whether it is set up; a drive that was switched off is not any more."""
        self.quiet = 0.0
        """Wall seconds for which nothing of it was heard."""
        self.untold = {STATUS: 0.0, MOTION: 0.0}
        """The same of its status and of its motion: a heartbeat tells neither."""
        self.waited = 0
        """How many times it was asked to tell its state since it did last."""

    @property
    def state(self) -> DriveState:
        """By the newest statusword."""
        return state_of(self.statusword)

    def take(self, service: int, data: bytes, now: float) -> bool:
        """Take a frame; True when it restarted. Raises ValueError for one of another length."""
        self.quiet = 0.0
        if service in self.untold:
            self.untold[service] = 0.0
        try:
            return self._take(service, data, now)
        except struct.error as error:
            raise ValueError(f"{service:03X}h of {len(data)} bytes") from error

    def _take(self, service: int, data: bytes, now: float) -> bool:
        if service == STATUS:
            self.statusword, self.position, self.mode = struct.unpack("<Hib", data)
            self.told, self.waited = now, 0
        elif service == MOTION:
            (self.velocity,) = struct.unpack_from("<i", data)
            if len(data) == 8:
                (self.inputs,) = struct.unpack_from("<I", data, 4)
            self.moved = now
        elif service == HEALTH:
            (self.code,) = struct.unpack_from("<H", data)
            if len(data) == 6:
                (self.millivolts,) = struct.unpack_from("<I", data, 2)
        elif service == EMERGENCY:
            code, _ = struct.unpack_from("<HB", data)
            if code & 0xFF00 == 0:
                self.emergencies.clear()
            elif code not in self.emergencies:
                self.emergencies = [*self.emergencies, code][-_KEPT:]
        elif service == HEARTBEAT:
            # Bit 7 is the toggle of node guarding.
            self.nmt, self.beaten = data[0] & 0x7F, now
            if self.nmt == BOOTED:
                restarted, self.configured = self.configured, False
                self.emergencies.clear()
                return restarted
        return False

    def trouble(self) -> tuple[str, ...]:
        """What of it ends motion, in words; empty when there is nothing."""
        found = []
        if self.state in (DriveState.FAULT, DriveState.REACTING):
            codes = self.emergencies or [self.code]
            found += [f"{self.side} drive: {meaning(code)}" for code in codes]
        return tuple(found)

    def left_command(self) -> str:
        """Why a drive that was enabled does not obey any more though it has no fault; "" when it obeys."""
        if not self.configured:
            return f"the {self.side} drive was restarted"
        if self.nmt is not None and self.nmt != OPERATIONAL:
            return f"the {self.side} drive is {NMT_STATES.get(self.nmt, f'in NMT state {self.nmt}')} on the bus"
        if not self.statusword & REMOTE:
            return f"the {self.side} drive is commanded locally (statusword {self.statusword:04X}h, bit 9)"
        if self.mode != PROFILE_VELOCITY:
            return f"the {self.side} drive is in mode {self.mode} instead of {PROFILE_VELOCITY}, profile velocity"
        if self.state is not DriveState.ENABLED:
            dead = ", without voltage" if not self.statusword & VOLTAGE else ""
            return f"the {self.side} drive left operation and is {self.state.value}{dead}"
        return ""

    def warnings(self) -> tuple[str, ...]:
        """What it says that does not end motion."""
        return (f"the {self.side} drive warns (statusword bit 7)",) if self.statusword & WARNING else ()
