"""The faults of a vehicle of two wheel drives, in words."""

from __future__ import annotations

from drivers.errors import DeviceFault

SETUP = "vehicle.setup"
TOLD_ONCE = ("vehicle.command_lost", "vehicle.disturbed", "vehicle.two_vehicles", "vehicle.units")
"""Codes of faults that end command: whoever is in charge afterwards is no fault of the vehicle."""


def drive_error(name: str, trouble: tuple[str, ...], *, driven: bool) -> DeviceFault:
    """Drives with a fault; one that came while the vehicle was `driven` is for a person to look at."""
    hint = (
        "It was driving: look what it may have driven against, and jog it away from there. Then run the job again."
        if driven
        else "What has passed is cleared by taking command again."
    )
    return DeviceFault(name, "vehicle.error", "; ".join(trouble), recoverable=not driven, hint=hint)


def command_lost(name: str, why: str) -> DeviceFault:
    """A drive does not obey any more, without a fault of its own."""
    return DeviceFault(
        name,
        "vehicle.command_lost",
        why,
        recoverable=False,
        hint="See why, look where the vehicle stands, then run the job again.",
    )


def wrong_units(name: str, mismatch: str) -> DeviceFault:
    """Speed and counts of a wheel contradict each other."""
    return DeviceFault(
        name,
        "vehicle.units",
        mismatch,
        recoverable=False,
        hint="Compare both with the drive's set-up, and try with the wheels off the floor.",
    )


def unguarded(name: str, who: str, took: float, allowed: float) -> DeviceFault:
    """A drive stays enabled without our heartbeat; `took` and `allowed` in s."""
    return DeviceFault(
        name,
        "vehicle.watchdog",
        f"without our heartbeat the {who} drive stays enabled, {took:.1f} s long (vehicle.watchdog is {allowed:g} s): "
        "it would drive on if this program died",
        recoverable=False,
        hint="Set object 6007h of the drive to 1, or try the other vehicle.guarding; see docs/how-to/canopen.md.",
    )


def unfit(name: str, what: str) -> DeviceFault:
    """A drive that cannot be used as it is."""
    return DeviceFault(
        name,
        SETUP,
        what,
        recoverable=False,
        hint="Compare the drive's manual with docs/how-to/canopen.md, which lists what a drive must have.",
    )
