"""The state machine of a CiA 402 drive: what a statusword says, and which controlword leads on."""

from __future__ import annotations

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
