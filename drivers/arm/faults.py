"""What ends the arm's motions: each fault's words, whether a program may clear it, and how a protective stop is."""

from __future__ import annotations

import time

from drivers.arm.dashboard import Dashboard
from drivers.clock import Clock
from drivers.errors import DeviceFault

_UNLOCK_S = 20.0

_FAULTS: dict[str, tuple[str, bool, str]] = {
    "arm.protective_stop": (
        "the arm is in protective stop", True, "Look for what it ran into, clear the way, then recover().",
    ),
    "arm.emergency_stop": (
        "the emergency stop is pressed", False,
        "Make the cell safe, release the button, switch the arm on at the pendant, brakes too, then recover().",
    ),
    "arm.safeguard_stop": ("the safeguard is open", False, "Close and acknowledge the safeguard, then go on."),
    "arm.safety_fault": ("the arm's safety system reports a fault", False, "Read the pendant's log; restart the arm."),
    "arm.not_powered": (
        "the arm is not powered", False, "Power it on and release its brakes at the pendant, then recover().",
    ),
    "arm.program_stopped": ("the control program does not run on the arm", True, "recover() starts it again."),
    "arm.not_arrived": ("the motion ended away from its target", True, "See what hinders the arm, then recover()."),
    "arm.not_stopped": ("the arm does not come to rest", False, "Use the emergency stop."),
    "arm.refused": ("the arm refused a command", True, "See that the target can be reached, then recover()."),
}  # fmt: skip


def fault(device: str, code: str, text: str = "") -> DeviceFault:
    """The `DeviceFault` for a code of the child process, with its text added."""
    what, recoverable, hint = _FAULTS.get(code, ("the arm driver failed", True, "recover() starts it again."))
    return DeviceFault(device, code, f"{what}: {text}" if text else what, recoverable=recoverable, hint=hint)


def unlock(device: str, dashboard: Dashboard, clock: Clock) -> None:
    """Release a protective stop; the controller allows it only some seconds after its beginning.

    Raises `DeviceFault` when the stop is one that only the operator can clear.
    """
    deadline = time.monotonic() + _UNLOCK_S
    while (status := dashboard.ask("safetystatus").rpartition(":")[2].strip()) != "NORMAL":
        if status != "PROTECTIVE_STOP":
            code = "arm.emergency_stop" if "EMERGENCY" in status else "arm.safety_fault"
            raise fault(device, "arm.safeguard_stop" if "SAFEGUARD" in status else code, status)
        dashboard.ask("close safety popup")
        reply = dashboard.ask("unlock protective stop")
        if time.monotonic() > deadline:
            raise fault(device, "arm.protective_stop", f"it could not be unlocked: {reply}")
        clock.sleep(0.1 * clock.rate)
