"""What ends the arm's motions: each fault's words, whether a program may clear it, and how a protective stop is."""

import time
from collections.abc import Callable

from drivers.arm.dashboard import Dashboard, unknown
from drivers.clock import Clock
from drivers.errors import DeviceFault

_UNLOCK_S = 20.0

_FAULTS: dict[str, tuple[str, bool, str]] = {
    "arm.protective_stop": (
        "the arm is in protective stop", True,
        "Look for what it ran into and clear the way; then a person confirms: `cell confirm`.",
    ),
    "arm.emergency_stop": (
        "the emergency stop is pressed", False,
        "Make the cell safe, release the button, switch the arm on at the pendant, brakes too, then `cell recover`.",
    ),
    "arm.safeguard_stop": ("the safeguard is open", False, "Close and acknowledge the safeguard, then go on."),
    "arm.safety_fault": ("the arm's safety system reports a fault", False, "Read the pendant's log; restart the arm."),
    "arm.recovery_mode": (
        "the arm is in recovery mode: it stands outside its safety limits", False,
        "At the pendant, move it back by hand into the limits of its safety configuration, then `cell recover`.",
    ),
    "arm.not_powered": (
        "the arm is not powered", False, "Power it on and release its brakes at the pendant, then `cell recover`.",
    ),
    "arm.program_stopped": ("the control program does not run on the arm", True, "`cell recover` starts it again."),
    "arm.not_arrived": (
        "the motion ended away from its target", True, "See what hinders the arm, then `cell recover`.",
    ),
    "arm.not_stopped": ("the arm does not come to rest", False, "Use the emergency stop."),
    "arm.not_safe": (
        "the arm is not known to be safe", False, "Use the emergency stop; see that it stands and the laser is off.",
    ),
    "arm.wrong_kinematics": (
        "the controller and the cell reckon with different kinematics", False,
        "See that nobody has set another tool at the pendant, that arm.address is this arm's, and that the controller "
        "has its own calibration (Settings, then see its calibration file); then connect anew.",
    ),
    "arm.wrong_model": (
        "the arm is not of the model that is configured", False, "Correct arm.model or arm.address in cell.toml.",
    ),
    "arm.wrong_payload": (
        "the controller reckons with another payload than this driver has set", True,
        "Somebody has set it at the pendant or by a program: see what the arm carries; `cell recover` sets it again.",
    ),
    "arm.local_control": (
        "the arm is in local control", False,
        "Switch it to remote control at the pendant (top right corner of its screen), then go on.",
    ),
    "arm.owner_frozen": (
        "this program gave no sign of life, so the process beside it stopped the arm", True,
        "The program was suspended, or this computer is too busy or swaps. End other programs, then go on.",
    ),
    "arm.link_lost": (
        "the link to the arm was lost", True, "See that the arm is on and connected, then `cell recover`.",
    ),
    "arm.refused": ("the arm refused a command", True, "See that the target can be reached, then `cell recover`."),
}  # fmt: skip


_STATUS = (
    ("EMERGENCY", "arm.emergency_stop"),
    ("SAFEGUARD", "arm.safeguard_stop"),
    ("THREE_POSITION", "arm.safeguard_stop"),
    ("RECOVERY", "arm.recovery_mode"),
)
"""What words of the dashboard server's safety status mean."""


LATE_S = 0.01
"""By how much what an arm is told may come late before that is named as the reason of a stop: five of its cycles."""
_BUSY = "this computer is too busy"


def late_words(seconds: float) -> str:
    """Why an arm stopped that was told its points so much late; empty for one that was told them in time."""
    return f"points came {1e3 * seconds:.0f} ms late: {_BUSY}" if seconds >= LATE_S else ""


def fault(device: str, code: str, text: str = "") -> DeviceFault:
    """The `DeviceFault` for a code of the child process, with its text added."""
    what, recoverable, hint = _FAULTS.get(code, ("the arm driver failed", True, "`cell recover` starts it again."))
    if _BUSY in text:
        hint = hint.replace(
            "Look for what it ran into and clear the way",
            "End what else computes here, and see that the arm touches nothing",
        )
    return DeviceFault(device, code, f"{what}: {text}" if text else what, recoverable=recoverable, hint=hint)


def require_remote(device: str, dashboard: Dashboard) -> None:
    """Raise `DeviceFault` (arm.local_control) when the arm says so; controllers that know of no such mode do not."""
    if dashboard.ask("is in remote control").lower() == "false":
        raise fault(device, "arm.local_control", "it takes nothing but questions from others")


def require_named(device: str, dashboard: Dashboard, model: str) -> None:
    """Raise `DeviceFault` (arm.wrong_model) when the arm calls itself otherwise than `model`. E-series controllers
    leave out the "e"; what names no model is left to the kinematics."""
    told = dashboard.ask("get robot model")
    plain = told.upper()
    if model and plain.startswith("UR") and plain not in (model.upper(), model.upper().removesuffix("E")):
        raise fault(device, "arm.wrong_model", f'it calls itself {told}, arm.model is "{model}"')


def unlock(
    device: str, dashboard: Dashboard, clock: Clock, confirmed: bool, require_wanted: Callable[[], None]
) -> None:
    """Release a protective stop that a person has `confirmed`; the controller allows it only some seconds after it.

    Raises `DeviceFault` when nobody has, when the stop is one that only the operator can clear or when the arm is in
    local control, and whatever `require_wanted` raises, which is asked before each try.
    """
    deadline = time.monotonic() + _UNLOCK_S
    while (status := _safety(dashboard)) not in ("NORMAL", "REDUCED"):
        if status != "PROTECTIVE_STOP":
            raise fault(device, next((code for word, code in _STATUS if word in status), "arm.safety_fault"), status)
        if not confirmed:
            raise fault(device, "arm.protective_stop", "nobody has confirmed that it may be unlocked")
        require_wanted()
        dashboard.ask("close safety popup")
        reply = dashboard.ask("unlock protective stop")
        require_remote(device, dashboard)
        if time.monotonic() > deadline:
            raise fault(device, "arm.protective_stop", f"it could not be unlocked: {reply}")
        clock.sleep(0.1 * clock.rate)


def _safety(dashboard: Dashboard) -> str:
    """The safety status in the maker's words; controllers before PolyScope 5.4 know it as the safety mode."""
    reply = dashboard.ask("safetystatus")
    return (dashboard.ask("safetymode") if unknown(reply) else reply).rpartition(":")[2].strip()
