"""What the vehicle's error bits and its motor drivers' status mean, in words, and which of them end motion.

Source: AgileX ugv_sdk, `agilex_message.h` (SYSTEM_ERROR_… and DRIVER_STATE_… masks). A bit that it does not name counts
as a fault.
"""

from __future__ import annotations

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
    """What the error bits of the system state (0x211) say that ends motion; empty when there is nothing.

    `commanded` says whether this program is in command by now.
    """
    return _words(bits & ~WARNINGS & ~(0 if commanded else UNCOMMANDED) & 0xFFFF, _SYSTEM, 4)


def system_warnings(bits: int) -> tuple[str, ...]:
    """What the error bits of the system state (0x211) say that does not end motion."""
    return _words(bits & WARNINGS, _WARNED, 4)


def driver_trouble(motor: int, status: int) -> tuple[str, ...]:
    """What the status of one motor's driver (0x261 …) says that ends motion; empty when there is nothing."""
    return tuple(f"motor {motor}: {word}" for word in _words(status & ~_DRIVER_WORKING & 0xFF, _DRIVER, 2))


def vehicle_error(name: str, bits: int, trouble: tuple[str, ...], *, driven: bool) -> DeviceFault:
    """The fault of a vehicle that reports an exception or trouble.

    One that came while it was `driven` may be a collision: that is for a person to look at, not for a program to clear.
    """
    said = "; ".join(trouble) or "no bit says which"
    hint = (
        "It was driving: look what it may have driven against, and jog it away from there. Then run the job again."
        if driven
        else "What has passed is cleared by taking command again; if it comes back, see the vehicle's manual."
    )
    text = f"reports an error, bits 0x{bits:04x}: {said}"
    return DeviceFault(name, "vehicle.error", text, recoverable=not driven, hint=hint)


def command_lost(name: str, mode: int) -> DeviceFault:
    """The fault of a vehicle that left CAN command: a person took the remote control, or it was restarted."""
    return DeviceFault(
        name,
        "vehicle.command_lost",
        f"left CAN command (mode {mode}): somebody took the remote control, or it was restarted",
        recoverable=False,
        hint="Give command back, look where the vehicle stands, then run the job again.",
    )


def emergency_stop(name: str) -> DeviceFault:
    """The fault of a vehicle whose emergency stop is pressed."""
    return DeviceFault(
        name,
        "vehicle.emergency_stop",
        "the emergency stop is pressed",
        recoverable=False,
        hint="Release the button when it is safe, then `cell recover`.",
    )


def no_feedback(name: str, what: str) -> DeviceFault:
    """The fault of a vehicle, or of a part of it, that is silent."""
    return DeviceFault(
        name,
        "vehicle.silent",
        what,
        recoverable=True,
        hint="Check that the vehicle is on and the CAN bus is connected.",
    )


def disturbed(name: str, what: str) -> DeviceFault:
    """The fault of a vehicle that somebody else commanded or moved."""
    return DeviceFault(
        name,
        "vehicle.disturbed",
        what,
        recoverable=False,
        hint="Find out who else commands or pushes the vehicle and end it, then run the job again.",
    )


def two_vehicles(name: str, what: str) -> DeviceFault:
    """The fault of feedback that contradicts itself: nobody knows which vehicle it tells of."""
    return DeviceFault(
        name,
        "vehicle.two_vehicles",
        f"{what}. Its motion and its standstill are not known",
        recoverable=False,
        hint="Take the other vehicle off the CAN bus, or give it identifiers of its own, then run the job again.",
    )


def _words(bits: int, names: dict[int, str], digits: int) -> tuple[str, ...]:
    each = (1 << k for k in range(bits.bit_length()) if bits >> k & 1)
    return tuple(names.get(bit, f"bit 0x{bit:0{digits}x}") for bit in each)
