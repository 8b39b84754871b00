"""Setting up one drive: is it one, does it count as configured, its ramps, its PDOs, its watchdog.

Everything that is written is read back. Nothing is stored in the drive: switched off and on it is as it was before.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from drivers.errors import ConfigError, DeviceFault
from drivers.vehicle.cia402 import drive as od
from drivers.vehicle.cia402.bus import SETUP, Absent, CanopenBus, unfit
from drivers.vehicle.cia402.drive import DISABLE_VOLTAGE, Entry, SideDrive, may_turn, state_of
from drivers.vehicle.cia402.feedback import SI_UNITS, WheelDrives

HEARTBEATS_IN_TIME = 5
"""So many of our heartbeats go into the time after which a drive stops without one."""
DRIVES_HEARTBEAT_MS = 100
_INVALID, _NO_REMOTE = 1 << 31, 1 << 30
_EACH_SYNC, _AT_ONCE, _SELDOM = 1, 255, 10
"""Transmission types: with each SYNC, when it comes, with each tenth SYNC."""


@dataclass(frozen=True)
class Watchdog:
    """How the drives notice that this program is gone: after `seconds` on the wall, by heartbeats of node `own`, or by
    node guarding."""

    guarding: Literal["heartbeat", "node"]
    seconds: float
    own: int

    @property
    def period(self) -> float:
        """Seconds on the wall from one sign of life to the next."""
        return self.seconds / HEARTBEATS_IN_TIME

    def arm(self, bus: CanopenBus, drive: SideDrive) -> None:
        """From its next sign of life on the drive watches this program."""
        if self.guarding == "heartbeat":
            _set(bus, drive, od.CONSUMER_HEARTBEAT, self.own << 16 | round(1e3 * self.seconds))
        else:
            _set(bus, drive, od.LIFE_FACTOR, HEARTBEATS_IN_TIME)
            _set(bus, drive, od.GUARD_TIME, round(1e3 * self.period))

    def disarm(self, bus: CanopenBus, drive: SideDrive) -> None:
        """It does not watch any more: who stands with locked brake may be left alone."""
        _set(bus, drive, od.CONSUMER_HEARTBEAT if self.guarding == "heartbeat" else od.GUARD_TIME, 0)


def set_up(bus: CanopenBus, drive: SideDrive, wheels: WheelDrives, watchdog: Watchdog) -> None:
    """Bring a drive that stands to where it can be commanded over PDOs, operation not enabled.

    Raises `ConfigError` when it counts otherwise than configured, `DeviceFault` when it is no drive, moves, lacks what
    is needed or keeps another value, `DeadlineError` when it does not answer.
    """
    _require_drive(bus, drive)
    compare_units(bus, drive, wheels)
    _require_rest(bus, drive, wheels)
    bus.command(drive.node, od.PRE_OPERATIONAL)
    if watchdog.guarding == "node":
        _set(bus, drive, od.PRODUCER_HEARTBEAT, 0, needed=False)
    else:
        # A node does either.
        _set(bus, drive, od.GUARD_TIME, 0, needed=False)
        _set(bus, drive, od.PRODUCER_HEARTBEAT, DRIVES_HEARTBEAT_MS)
    watchdog.disarm(bus, drive)
    _set(bus, drive, od.ABORT_CONNECTION, 1, needed=False)  # a fault; that it stops is proved by trial
    _set(bus, drive, od.COMMUNICATION_ERROR, 1, needed=False)  # and goes on telling its state
    _set(bus, drive, od.QUICK_STOP_OPTION, 2, needed=False)  # the ramp, then without power
    _set(bus, drive, od.FAULT_REACTION, 2, needed=False)  # the same ramp
    _set(bus, drive, od.HALT_OPTION, 1, needed=False)  # the ramp, and held
    _set(bus, drive, od.ACCELERATION, wheels.ramp(wheels.acceleration))
    _set(bus, drive, od.DECELERATION, wheels.ramp(wheels.deceleration))
    _set(bus, drive, od.QUICK_STOP_DECELERATION, wheels.ramp(wheels.deceleration))
    _set(bus, drive, od.TARGET_VELOCITY, 0)
    _set(bus, drive, od.MODE, od.PROFILE_VELOCITY)
    _map_all(bus, drive, wheels)
    if wheels.brake_output is not None:
        lock(bus, drive, wheels, locked=True)
    bus.command(drive.node, od.START)
    drive.configured = True


def compare_units(bus: CanopenBus, drive: SideDrive, wheels: WheelDrives) -> None:
    """`ConfigError` when the drive says that it counts, or measures speed, otherwise than configured."""
    counts, turns = (bus.read_if_there(drive.node, entry) for entry in (od.ENCODER_INCREMENTS, od.ENCODER_TURNS))
    if counts and turns and abs(counts / turns - wheels.counts) > 0.5:
        raise ConfigError(
            f"the {drive.side} drive (node {drive.node}) counts {counts / turns:g} per turn of its motor by its object "
            f"608Fh; vehicle.counts_per_turn is {wheels.counts}. Correct the one that is wrong"
        )
    unit = bus.read_if_there(drive.node, od.VELOCITY_UNIT)
    named = {code: name for name, code in SI_UNITS.items()}
    if unit in named and named[unit] != wheels.velocity_unit:
        raise ConfigError(
            f"the {drive.side} drive (node {drive.node}) measures speed in {named[unit]} by its object 60A9h; "
            f'vehicle.velocity_unit is "{wheels.velocity_unit}". Correct the one that is wrong'
        )


def lock(bus: CanopenBus, drive: SideDrive, wheels: WheelDrives, *, locked: bool) -> None:
    """Switch the output of the drive that its brake hangs on, and read it back."""
    assert wheels.brake_output is not None
    bit = 1 << wheels.brake_output
    mask = bus.read_if_there(drive.node, od.OUTPUT_MASK)
    if mask is not None and not mask & bit:
        _set(bus, drive, od.OUTPUT_MASK, mask | bit)
    now = bus.read(drive.node, od.OUTPUTS)
    _set(bus, drive, od.OUTPUTS, now | bit if locked == wheels.brake_locks else now & ~bit)


def _require_drive(bus: CanopenBus, drive: SideDrive) -> None:
    profile = bus.read(drive.node, od.DEVICE_TYPE) & 0xFFFF
    if profile != od.DRIVE_PROFILE:
        raise _unfit(bus, drive, f"is no drive: its profile is CiA {profile}, not {od.DRIVE_PROFILE}")
    modes = bus.read_if_there(drive.node, od.SUPPORTED_MODES)
    if modes is not None and not modes & od.PROFILE_VELOCITY_BIT:
        raise _unfit(bus, drive, f"has no profile velocity mode (object 6502h is {modes:08X}h)")


def _require_rest(bus: CanopenBus, drive: SideDrive, wheels: WheelDrives) -> None:
    """A drive that somebody left enabled is switched off when it stands, and left alone when it turns."""
    if not may_turn(state_of(bus.read(drive.node, od.STATUSWORD))):
        return
    speed = abs(bus.read(drive.node, od.VELOCITY)) * wheels.velocity_step
    if speed > 0.01:
        raise DeviceFault(
            bus.name,
            "vehicle.disturbed",
            f"the {drive.side} drive turns its wheel at {speed:.3f} m/s, though this program does not command it",
            recoverable=False,
            hint="Find out who commands the vehicle and end it, then connect again.",
        )
    bus.write(drive.node, od.CONTROLWORD, DISABLE_VOLTAGE)


def _map_all(bus: CanopenBus, drive: SideDrive, wheels: WheelDrives) -> None:
    motion = [od.VELOCITY] if wheels.stop_input is None else [od.VELOCITY, od.INPUTS]
    health = [od.ERROR_CODE] if bus.read_if_there(drive.node, od.DC_LINK) is None else [od.ERROR_CODE, od.DC_LINK]
    _map(bus, drive, 0x1400, service=od.COMMAND, transmission=_AT_ONCE, entries=[od.CONTROLWORD, od.TARGET_VELOCITY])
    _map(bus, drive, 0x1800, od.STATUS, transmission=_EACH_SYNC, entries=[od.STATUSWORD, od.POSITION, od.MODE_DISPLAY])
    _map(bus, drive, 0x1801, service=od.MOTION, transmission=_EACH_SYNC, entries=motion)
    _map(bus, drive, 0x1802, service=od.HEALTH, transmission=_SELDOM, entries=health)


def _map(
    bus: CanopenBus, drive: SideDrive, parameter: int, service: int, transmission: int, entries: Sequence[Entry]
) -> None:
    """Give a PDO its identifier, when it is sent, and what is in it. Mapped as CiA 301 has it, while it is invalid."""
    identifier = Entry(parameter, 1, "<I", "PDO, identifier")
    mapping = parameter + 0x200
    count = Entry(mapping, 0, "<B", "PDO, mapped values")
    own = bus.read(drive.node, identifier) & _NO_REMOTE | service + drive.node
    bus.write(drive.node, identifier, own | _INVALID)
    _set(bus, drive, Entry(parameter, 2, "<B", "PDO, transmission type"), transmission)
    bus.write(drive.node, count, 0)
    for k, entry in enumerate(entries, 1):
        _set(bus, drive, Entry(mapping, k, "<I", f"PDO, {entry.name}"), entry.mapping)
    _set(bus, drive, count, len(entries))
    _set(bus, drive, identifier, own)


def _set(bus: CanopenBus, drive: SideDrive, entry: Entry, value: int, *, needed: bool = True) -> None:
    """Write and read back; what is not `needed` may be absent or refused, not different after it was taken."""
    try:
        bus.write(drive.node, entry, value)
    except Absent as absent:
        if needed and bus.read_if_there(drive.node, entry) != value:
            raise _unfit(bus, drive, f"lets {entry} not be set to {value}: {absent}") from absent
        return
    except DeviceFault as refusal:
        if needed or refusal.code != SETUP:
            raise
        return
    if (kept := bus.read_if_there(drive.node, entry)) not in (value, None):
        raise _unfit(bus, drive, f"took {entry} = {value} and keeps {kept}")


def _unfit(bus: CanopenBus, drive: SideDrive, what: str) -> DeviceFault:
    return unfit(bus.name, f"the {drive.side} drive (node {drive.node}) {what}")
