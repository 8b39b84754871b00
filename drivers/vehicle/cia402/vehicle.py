"""A vehicle of two wheel drives on CANopen CiA 402, in profile velocity mode (docs/how-to/canopen.md). Never run on
hardware.

When this program is gone, the drives stop by their own watchdog. That they do is tried at speed 0, once per connection.
"""

import threading
from collections.abc import Sequence
from functools import partial

import can

from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceFault, InterlockError, NotConnectedError, check_range
from drivers.interfaces import Identity, LinkStatistics, Reading, VehicleState
from drivers.vehicle.cia402 import drive as od
from drivers.vehicle.cia402 import master
from drivers.vehicle.cia402.bus import TOLD_ONCE, CanopenBus
from drivers.vehicle.cia402.drive import SideDrive
from drivers.vehicle.cia402.feedback import DriveFeedback, WheelDrives
from drivers.vehicle.cia402.master import Master
from drivers.vehicle.cia402.setup import Watchdog, compare_units
from drivers.vehicle.health import MOST_LOAD, bus_readings, can_interface, most_bits


def readings(
    heard: Sequence[can.Message], seconds: float, bitrate: int, others: int, drives: Sequence[SideDrive],
    system_name: str | None, judged: bool,
) -> list[Reading]:  # fmt: skip
    """Figures of what was heard in `seconds` of the clock; `others` frames by which somebody else commanded.

    Without `judged`, on a clock that is not the wall's, the load has no limit. `system_name` is the computer's CAN
    interface, where it has one.
    """
    bits = sum(most_bits(frame) for frame in heard)
    found = [
        Reading(
            "bus load, at most", 100.0 * bits / (bitrate * seconds), "%",
            most=MOST_LOAD if judged else None, remedy="Take others off the CAN bus, or raise its bit rate.",
        ),
        Reading(
            "frames of another master", float(others), "", most=0.0,
            remedy="Find out who else sends SYNC, NMT, or commands to the drives, and end it.",
        ),
        *bus_readings(heard, None if system_name is None else can_interface(system_name)),
    ]  # fmt: skip
    # What is too low for the cells of its battery, the drive knows, and says by its error code.
    found += [
        Reading(f"supply, {drive.side} drive", 1e-3 * drive.millivolts, "V")
        for drive in drives
        if drive.millivolts is not None
    ]
    return found


STOP_TIMEOUT_S = 4.0
RAMP_SLACK_S = 0.7
"""So much later than its ramp says a halted vehicle may stand, before it is stopped with the quick stop."""


class CanopenVehicle:
    """The vehicle `wheels` on the python-can bus (`interface`, `channel`); `max_speed` in m/s, `max_yaw_rate` in rad/s.

    With `look` nothing on the drives is set: they are asked by SDO. Raises `NotConnectedError` or `DeadlineError` when
    they do not answer, `DeviceFault` when somebody else commands them or they are unfit, `ConfigError` when they count
    otherwise than configured.
    """

    def __init__(
        self, name: str, interface: str, channel: str, *, wheels: WheelDrives, watchdog: Watchdog, max_speed: float,
        max_yaw_rate: float, clock: Clock, bitrate: int = 500_000, look: bool = False,
    ) -> None:  # fmt: skip
        self.name = name
        self.statistics = LinkStatistics()
        self._address = f"{interface}:{channel}"
        self._system_name = channel if interface == "socketcan" else None
        self._bitrate = bitrate
        self._wheels = wheels
        self._max_speed, self._max_yaw_rate = max_speed, max_yaw_rate
        self._clock = clock
        self._look = look
        self._feedback = DriveFeedback(
            name, clock, wheels, max_speed=max_speed, max_yaw_rate=max_yaw_rate, statistics=self.statistics
        )
        self._in_command = False
        self._braked: bool | None = None
        self._interruptions = 0
        """How many there had been when the brake was commanded: one more, and it may have been released since."""
        self._ends = 0
        """How many stops were asked for."""
        self._closed = threading.Event()
        open_bus = partial(
            CanopenBus, name, interface, channel, bitrate=bitrate, own=watchdog.own,
            nodes=wheels.nodes, take=self._feedback.take, other=self._feedback.other, idle=self._feedback.idle,
            statistics=self.statistics,
            alone=f"the drives stop by themselves {watchdog.seconds:g} s after the last sign of life",
        )  # fmt: skip
        self._master = Master(name, open_bus, self._feedback, wheels, watchdog, clock=clock, statistics=self.statistics)
        try:
            if look:
                for drive in self._feedback.drives:
                    compare_units(self._bus, drive, wheels)
            else:
                self._master.begin()
        except BaseException:
            self._master.close()
            raise

    @property
    def _bus(self) -> CanopenBus:
        return self._master.bus

    def identity(self) -> Identity:
        """Names and versions as the drives tell them, and the serial numbers of both."""
        self._bus.check()
        told = [
            (
                self._bus.text(drive.node, *od.DEVICE_NAME) or f"vendor {self._bus.read(drive.node, od.VENDOR):X}h",
                master.number(self._bus, drive, od.SERIAL),
                self._bus.text(drive.node, *od.SOFTWARE) or "unknown",
            )
            for drive in self._feedback.drives
        ]
        names, serials, versions = (" and ".join(dict.fromkeys(part)) for part in zip(*told, strict=True))
        return Identity(f"CiA 402, {names}", serials, versions, self._address)

    def ping(self) -> float:
        """How long, in wall seconds, a drive takes for one answer by SDO, the mean of both. Raises `DeadlineError`."""
        self._bus.check()
        before = self._clock.now()
        for drive in self._feedback.drives:
            self._bus.read(drive.node, od.ERROR_REGISTER)
        taken = self._clock.wall(self._clock.now() - before) / len(self._feedback.drives)
        self.statistics.add_round_trip(taken)
        return taken

    def examine(self, seconds: float) -> list[Reading]:
        """How the bus is used in `seconds`, and what the drives tell; see `drivers.vehicle.cia402.vehicle`."""
        before = self.statistics.errors.get("other_master", 0)
        with self._bus.listening() as frames:
            self._clock.wait(self._closed, seconds)
        self._bus.check()
        others = self.statistics.errors.get("other_master", 0) - before
        judged = self._clock.rate <= 1.0
        heard = [frame for _, frame in frames]
        drives = self._feedback.drives
        return readings(
            heard, seconds, self._bitrate, others=others, drives=drives, system_name=self._system_name, judged=judged
        )

    def state(self, max_age: float = 0.2) -> VehicleState:
        """The newest feedback, at most `max_age` s old, else `DeadlineError`."""
        self._bus.check()
        if self._look:
            master.ask(self._bus, self._feedback, self._wheels)
        with self._master.command:
            braked, in_command = self._braked, self._in_command
        if braked and (self._feedback.may_turn() or self._feedback.interruptions != self._interruptions):
            braked = None
        return self._feedback.state(max_age, braked, in_command)

    def check(self) -> None:
        """Raise the `DeviceFault` that the drives show now; see `DriveFeedback.check`. Returns at once otherwise.

        A vehicle that somebody else commands, or that does not obey, is out of command from then on, until it is
        enabled again.
        """
        self._check(driving=False)

    def _check(self, driving: bool) -> None:
        self._bus.check()
        with self._master.command:
            in_command, lost = self._in_command, self._master.lost
        try:
            self._feedback.check(in_command=in_command, driving=driving, lost=lost)
        except DeviceFault as fault:
            if fault.code in TOLD_ONCE:
                with self._master.command:
                    if self._master.enabled:
                        self._master.quick_stop(fault.message)
                    self._in_command, self._master.lost = False, None
            raise

    def enable(self) -> None:
        """Take command, enable operation and release the brake; opens the bus again if it had failed.

        Raises `DeviceFault` on an emergency stop, a fault that does not clear, or drives that do not stop without our
        heartbeat; `DeadlineError` when they do not follow; `Aborted` when it was stopped meanwhile.
        """
        ends = self._ends
        self._take_command()
        self._master.operate()
        self._master.lock_brakes(locked=False)
        with self._master.command:
            stopped = self._ends != ends
            if not stopped:
                self._braked, self._interruptions = False, self._feedback.interruptions
                self._master.enabled = True
        if stopped:
            self._master.end_operation()
            raise Aborted(f"{self.name}: it was stopped while it was enabled")

    def recover(self) -> None:
        """Take command and clear faults with the brake locked throughout: the vehicle stays where it was measured."""
        self._take_command()
        self._master.switch_on()
        self.brake()

    def _take_command(self) -> None:
        if self._closed.is_set() or self._look:
            what = "was closed" if self._closed.is_set() else "is only looked at"
            raise NotConnectedError(self.name, f"the vehicle {what}. Open it again")
        self._master.take_command()
        with self._master.command:
            self._in_command = True

    def drive(self, speed: float, yaw_rate: float) -> None:
        """Set the velocity, m/s and rad/s; must be renewed within 0.5 s or it becomes zero. Raises `LimitError`,
        `InterlockError` before `enable()`, `DeviceFault` as `check` does, `Aborted` while a stop is under way."""
        speed = check_range(self.name, "speed", speed, low=-self._max_speed, high=self._max_speed, unit="m/s")
        yaw_rate = check_range(self.name, "yaw rate", yaw_rate, -self._max_yaw_rate, self._max_yaw_rate, unit="rad/s")
        self._bus.require_unspoken()
        self._check(driving=True)
        with self._master.command:
            if self._master.stops:
                raise Aborted(f"{self.name}: a stop is under way")
            lost, braked = self._master.lost is not None, self._braked
            if self._master.enabled and not braked and not lost:
                self._master.set_velocity(speed, yaw_rate)
                return
        if lost:
            # Since the check above: it is the fault and no mistake of whoever drives.
            self._check(driving=True)
        reason = "the brake is locked" if braked else "operation is not enabled"
        raise InterlockError(self.name, f"{reason}, so it would not move. Call enable() first")

    def stop(self) -> None:
        """Halt at once and wait until both drives report standstill; `DeadlineError` after 4 s. Drives that do not
        follow the ramp of the halt are stopped with the quick stop."""
        if self._look:
            return
        with self._master.command:
            self._master.stops += 1
            self._ends += 1
        try:
            asked = self._clock.now()
            speed = max(abs(drive.velocity) for drive in self._feedback.drives) * self._wheels.velocity_step
            with self._master.command:
                self._master.set_velocity(0.0, 0.0)
            if self._stands(asked, min(speed / self._wheels.deceleration + RAMP_SLACK_S, STOP_TIMEOUT_S)):
                return
            self._bus.check()
            self._master.quick_stop("the drives did not follow the ramp of a halt")
            if not self._stands(asked, STOP_TIMEOUT_S):
                self._bus.check()
                raise DeadlineError(
                    self.name,
                    f"did not report standstill within {STOP_TIMEOUT_S:.0f} s of the quick stop. Press its emergency "
                    "stop",
                )
        finally:
            with self._master.command:
                self._master.stops -= 1

    def brake(self) -> None:
        """Stop, wait for standstill and lock the brake; it stays locked until `enable()`. The brake is locked also when
        standstill is not reported in time, which is raised afterwards."""
        if self._look:
            return
        with self._master.command:
            self._master.stops += 1
        try:
            self.stop()
        finally:
            # No drive() between the standstill and the brake.
            with self._master.command:
                # Until it has been read back that it is locked nobody knows.
                self._braked, interruptions = None, self._feedback.interruptions
                self._master.enabled = False
                self._master.stops -= 1
            self._master.end_operation()
            with self._master.command:
                self._braked, self._interruptions = True, interruptions

    def close(self) -> None:
        """Stop the vehicle and lock its brake, end the threads and shut the bus down."""
        if self._closed.is_set():
            return
        try:
            # Whoever never commanded it has nothing to end, and another may be driving it.
            if self._in_command or self._master.armed:
                self.brake()
        finally:
            self._closed.set()
            self._master.close()

    def _stands(self, since: float, timeout: float) -> bool:
        return self._feedback.wait_for(partial(self._feedback.stands, since), timeout, lambda: self._bus.alive)
