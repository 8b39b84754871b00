"""The safe stop as every run and every ending uses it, and what in the cell's health ends a run."""

from __future__ import annotations

from cell.devices.devices import Devices
from drivers.errors import DeadlineError, DeviceError, DeviceFault
from drivers.interfaces import ArmSafety


def stop_cell(devices: Devices) -> None:
    """Bring every device to rest; raises `DeviceFault` that lists what could not be confirmed."""
    if problems := devices.stop():
        raise stop_not_confirmed("; ".join(problems))


def stop_not_confirmed(message: str) -> DeviceFault:
    """The fault of a cell of which it is not known that it stands."""
    return DeviceFault("cell", "safe_stop", message, recoverable=False, hint="Look at the cell before going near it.")


def require_healthy(devices: Devices) -> None:
    """Raise when a safety system has stopped the arm, or the vehicle has a fault, whichever device is waited for.

    An emergency stop is told before anything else: a person may be asked about the other fault meanwhile. A reading
    that is too old says nothing here: the next command to that device finds a silent link.
    """
    require_no_emergency_stop(devices)
    _require_arm(devices)
    if "vehicle" not in devices:
        return
    try:
        devices.vehicle.check()
    except DeadlineError:
        return


def require_no_emergency_stop(devices: Devices) -> None:
    """Raise when an emergency stop is pressed. For jogs, whose work may be to clear any other fault."""
    _require_arm(devices, ArmSafety.EMERGENCY_STOP)
    if "vehicle" not in devices:
        return
    try:
        pressed = devices.vehicle.state().emergency_stop
    except DeviceError:
        return
    if pressed:
        devices.vehicle.check()


def _require_arm(devices: Devices, *unfit: ArmSafety) -> None:
    """Raise when the arm's safety system has stopped it; with `unfit` only in these states."""
    if "arm" not in devices:
        return
    try:
        state = devices.arm.state()
        safety = state.safety
    except DeviceError as error:
        # A late state, or a link that `recover` has closed and opens again: the next command finds what is wrong.
        if isinstance(error, DeadlineError) or getattr(error, "code", "") == "arm.link_closed":
            return
        raise
    if safety in unfit if unfit else safety is not ArmSafety.NORMAL:
        raise DeviceFault(
            "arm",
            f"arm.{safety.name.lower()}",
            ": ".join(filter(None, (f"the arm is in {safety.value}", state.reason))),
            recoverable=safety is ArmSafety.PROTECTIVE_STOP,
            hint="Look for the reason and clear the way.",
        )
