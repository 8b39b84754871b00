"""What the vehicle's error bits and its motor drivers' status mean, in words, and which of them end motion.

Source: AgileX ugv_sdk, `agilex_message.h` (SYSTEM_ERROR_… and DRIVER_STATE_… masks). A bit that it does not name counts
as a fault.
"""

from drivers.errors import DeviceFault

_SYSTEM = {
    0x0001: "the battery's voltage is too low",
    0x0008: "motor 1 does not communicate",
    0x0010: "motor 2 does not communicate",
    0x0020: "motor 3 does not communicate",
    0x0040: "motor 4 does not communicate",
    0x0080: "the steering encoder fails",
    0x0100: "a motor driver fails",
    0x0200: "commands stayed away",
}
UNCOMMANDED = 0x0200
"""No fault of a vehicle that nobody commands."""
_WARNED = {0x0002: "the battery is low", 0x0004: "no signal of the remote control"}
WARNINGS = 0x0002 | 0x0004
"""Worth knowing, but the vehicle drives."""
_DRIVER = {
    0x01: "input voltage too low",
    0x02: "motor too hot",
    0x04: "overloaded",
    0x08: "driver too hot",
    0x10: "sensor fails",
    0x20: "driver fails",
}
_DRIVER_WORKING = 0x40 | 0x80
"""Enabled and reset: states, no faults."""
OUT_OF_COMMAND = ("vehicle.command_lost", "vehicle.disturbed", "vehicle.two_vehicles")
"""Codes of the faults that mean that somebody else is in charge, or may be."""


def system_trouble(bits: int, *, commanded: bool) -> tuple[str, ...]:
    """What the error bits of the system state (0x211) say that ends motion; empty when there is nothing. `commanded`
    says whether this program is in command by now."""
    return _words(bits & ~WARNINGS & ~(0 if commanded else UNCOMMANDED) & 0xFFFF, _SYSTEM, 4)


def system_warnings(bits: int) -> tuple[str, ...]:
    """What the error bits of the system state (0x211) say that does not end motion."""
    return _words(bits & WARNINGS, _WARNED, 4)


def driver_trouble(motor: int, status: int) -> tuple[str, ...]:
    """What the status of one motor's driver (0x261 …) says that ends motion; empty when there is nothing."""
    return tuple(f"motor {motor}: {word}" for word in _words(status & ~_DRIVER_WORKING & 0xFF, _DRIVER, 2))


_FAULTS: dict[str, tuple[str, bool, str]] = {
    "vehicle.command_lost": (
        "somebody took the remote control, or it was restarted, or a drive does not obey any more", False,
        "Give command back, look where the vehicle stands, then run the job again.",
    ),
    "vehicle.disturbed": (
        "somebody else commanded or moved it", False,
        "Find out who else commands or pushes the vehicle and end it, then run the job again.",
    ),
    "vehicle.emergency_stop": (
        "the emergency stop is pressed", False, "Release the button when it is safe, then `cell recover`.",
    ),
    "vehicle.setup": (
        "a drive cannot be used as it is", False,
        "Compare the drive's manual with docs/how-to/canopen.md, which lists what a drive must have.",
    ),
    "vehicle.silent": (
        "it, or a part of it, is silent", True, "Check that the vehicle is on and the CAN bus is connected.",
    ),
    "vehicle.two_vehicles": (
        "its motion and its standstill are not known", False,
        "Take the other vehicle off the CAN bus, or give it identifiers of its own, then run the job again.",
    ),
    "vehicle.units": (
        "speed and counts of a wheel contradict each other", False,
        "Compare both with the drive's set-up, and try with the wheels off the floor.",
    ),
    "vehicle.watchdog": (
        "a drive stays enabled without our heartbeat", False,
        "Set object 6007h of the drive to 1, or try the other vehicle.guarding; see docs/how-to/canopen.md.",
    ),
}  # fmt: skip


def vehicle_fault(name: str, code: str, text: str = "", hint: str = "") -> DeviceFault:
    """The fault of the vehicle `name` with this code, in words and with a hint of its own where they are given."""
    what, recoverable, usual = _FAULTS[code]
    return DeviceFault(name, code, text or what, recoverable=recoverable, hint=hint or usual)


def vehicle_error(name: str, bits: int, trouble: tuple[str, ...], *, driven: bool) -> DeviceFault:
    """The fault of a vehicle that reports an exception or trouble; see `drive_error`."""
    text = f"reports an error, bits 0x{bits:04x}: {'; '.join(trouble) or 'no bit says which'}"
    return drive_error(name, text, driven=driven, more="; if it comes back, see the vehicle's manual.")


def drive_error(name: str, text: str, *, driven: bool, more: str = ".") -> DeviceFault:
    """The fault of a vehicle or a drive that reports one, with `more` in its hint where it was not `driven`. One that
    came while it was driven may be a collision: that is for a person to look at, not for a program to clear."""
    hint = (
        "It was driving: look what it may have driven against, and jog it away from there. Then run the job again."
        if driven
        else f"What has passed is cleared by taking command again{more}"
    )
    return DeviceFault(name, "vehicle.error", text, recoverable=not driven, hint=hint)


def two_vehicles(name: str, what: str) -> DeviceFault:
    """The fault of feedback that contradicts itself: nobody knows which vehicle it tells of."""
    return vehicle_fault(name, "vehicle.two_vehicles", f"{what}. Its motion and its standstill are not known")


def _words(bits: int, names: dict[int, str], digits: int) -> tuple[str, ...]:
    each = (1 << k for k in range(bits.bit_length()) if bits >> k & 1)
    return tuple(names.get(bit, f"bit 0x{bit:0{digits}x}") for bit in each)
