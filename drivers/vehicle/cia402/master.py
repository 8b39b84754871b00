"""This program as the master of both drives: set-up, signs of life, set points, the way through the drives' states.

A thread sends SYNC and signs of life and, while the vehicle may be driven, both target velocities. One wheel alone
never drives: when one drive gives up, both are stopped with the quick stop.

When this process is killed, both quick stops are sent, then the brakes' outputs."""

import logging
import math
import struct
import threading
from collections.abc import Callable
from functools import partial

from drivers.clock import Clock
from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, NotConnectedError
from drivers.interfaces import LinkStatistics
from drivers.vehicle.can_link import data_frame
from drivers.vehicle.cia402 import drive as od
from drivers.vehicle.cia402 import drive as states
from drivers.vehicle.cia402.bus import CanopenBus
from drivers.vehicle.cia402.drive import QUICK_STOP, DriveState, SideDrive
from drivers.vehicle.cia402.feedback import DriveFeedback, WheelDrives
from drivers.vehicle.cia402.setup import Watchdog, lock, set_up
from drivers.vehicle.faults import vehicle_fault


def ask(bus: CanopenBus, feedback: DriveFeedback, wheels: WheelDrives) -> None:
    """Bring `feedback` up to date. Raises what `CanopenBus.read` does; a value that a drive lacks is left out."""
    for drive in feedback.drives:
        motion = struct.pack("<i", bus.read(drive.node, od.VELOCITY))
        if wheels.stop_input is not None:
            motion += struct.pack("<I", bus.read(drive.node, od.INPUTS))
        feedback.take(drive.node, od.MOTION, motion, in_pdo=False)
        health = struct.pack("<H", bus.read_if_there(drive.node, od.ERROR_CODE) or 0)
        if (millivolts := bus.read_if_there(drive.node, od.DC_LINK)) is not None:
            health += struct.pack("<I", millivolts)
        feedback.take(drive.node, od.HEALTH, health, in_pdo=False)
        told = [bus.read(drive.node, entry) for entry in (od.STATUSWORD, od.POSITION, od.MODE_DISPLAY)]
        feedback.take(drive.node, od.STATUS, struct.pack("<Hib", *told), in_pdo=False)


def number(bus: CanopenBus, drive: SideDrive, entry: od.Entry) -> str:
    """A number of the drive as text, "" where it has none."""
    told = bus.read_if_there(drive.node, entry)
    return "" if told is None else str(told)


_EXPEDITED_4 = 0x23


def last_words(wheels: WheelDrives) -> list[tuple[int, bytes]]:
    """Identifiers and data. With a brake on an output, all outputs of the drives are set to where it is locked."""
    stop = od.CONTROLWORD.pack(QUICK_STOP) + od.TARGET_VELOCITY.pack(0)
    words = [(od.COMMAND + node, stop) for _ in range(3) for node in wheels.nodes]
    if wheels.brake_output is not None:
        level = 1 << wheels.brake_output if wheels.brake_locks else 0
        request = struct.pack("<BHBI", _EXPEDITED_4, od.OUTPUTS.index, od.OUTPUTS.sub, level)
        words += [(od.SDO_REQUEST + node, request) for node in wheels.nodes]
    return words


SYNC_S, SYNC_AT_REST_S = 0.020, 0.050
_SYNC_WALL_S = 0.010
DEAD_MAN_S = 0.5
"""A velocity that has not been renewed for this long is replaced by zero."""
WALK_TIMEOUT_S = 2.0
"""For the way to another state of the drives."""
FIRST_FEEDBACK_S = 1.0
LISTEN_S = 0.3
"""On the wall: before anything is set, whether somebody else commands these drives."""
_STEP_WALL_S = 0.1
_HEARTBEAT_WALL_S = 0.3

_log = logging.getLogger(__name__)


class Master:
    """Commands both drives over the bus that `open_bus` gives; `begin` sets them up.

    `command` guards what is sent: else an older velocity could follow the zero of a stop. `enabled`: the vehicle may be
    driven. `lost` is why it may not any more, until that was told.
    """

    def __init__(
        self, name: str, open_bus: Callable[[], CanopenBus], feedback: DriveFeedback, wheels: WheelDrives,
        watchdog: Watchdog, clock: Clock, statistics: LinkStatistics,
    ) -> None:  # fmt: skip
        self._name = name
        self._open = open_bus
        self._feedback, self._wheels, self._watchdog = feedback, wheels, watchdog
        self._drives = feedback.drives
        self._clock, self._statistics = clock, statistics
        self.command = threading.RLock()
        self.bus = open_bus()
        self.enabled = self.armed = False
        self.lost: DeviceFault | None = None
        self.stops = 0
        """Stops that are under way."""
        self._velocity = (0.0, 0.0)
        self._renewed = -math.inf
        self._words = (states.DISABLE_VOLTAGE, states.DISABLE_VOLTAGE)
        self._proved = self._mute = False
        self._closed = threading.Event()
        self._keeper = threading.Thread(target=self._keep, name=f"{name} keep-alive", daemon=True)

    def begin(self) -> None:
        """Set up drives that nobody else commands, and have them tell their state."""
        self._closed.wait(LISTEN_S)
        if what := self._feedback.disturbance:
            raise vehicle_fault(self._name, "vehicle.disturbed", what)
        self.set_up()
        self._keeper.start()
        self.require_feedback()

    def close(self) -> None:
        """End the thread and shut the bus down; stops nothing."""
        self._closed.set()
        if self._keeper.ident is not None:
            self._keeper.join(2.0)
        self.bus.close()

    def take_command(self) -> None:
        """Open a bus that has failed again, set up drives that were switched off, hear how they are."""
        with self.command:
            self._velocity = (0.0, 0.0)
            self.enabled, self.lost = False, None
            if not self.bus.alive:
                self.bus.close()
                self.bus = self._open()
                for drive in self._drives:
                    drive.configured = False
                self._statistics.count("reopened")
                self._feedback.interrupt("the CAN bus failed and was opened again")
        self._feedback.acknowledge()
        self.set_up()
        self.bus.say_in_the_end([data_frame(*word) for word in last_words(self._wheels)])
        self.require_feedback()
        self._feedback.require_one()
        self._feedback.require_released()

    def set_up(self) -> None:
        """Set up the drives that are not set up, and start the others, which may have left the operational state."""
        for drive in self._drives:
            if not drive.configured:
                set_up(self.bus, drive, self._wheels, self._watchdog)
                self.armed = False
            else:
                self.bus.command(drive.node, od.START)

    def require_feedback(self) -> None:
        """Wait for both drives' PDOs; `NotConnectedError` that names who tells nothing."""
        since = self._clock.now()
        newer = partial(self._feedback.newer, since)
        if not self._feedback.wait_for(newer, FIRST_FEEDBACK_S, self._alive):
            self.bus.check()
            silent = " and ".join(drive.side for drive in self._drives if min(drive.told, drive.moved) <= since)
            raise NotConnectedError(
                self._name,
                f"the {silent} drive was set up and tells nothing in PDOs. See whether it is operational on the bus, "
                "and whether it answers SYNC",
            )

    def operate(self) -> None:
        """Both drives to operation enabled, at speed 0; for the first time their watchdog is tried."""
        self._operate()
        if not self._proved:
            self._feedback.proving = True
            try:
                self._prove_watchdog()
                self._operate()
            finally:
                self._feedback.proving = False
        # What a drive told of itself before it was started may still be on its way.
        self._feedback.wait_for(self._feedback.operational, 0.0, self._alive, _HEARTBEAT_WALL_S)

    def switch_on(self) -> None:
        """Both drives to switched on, where no motor turns; faults are reset."""
        self._walk(states.leads_to_switched_on, DriveState.SWITCHED_ON)

    def _operate(self) -> None:
        self.switch_on()
        if not self.armed:
            for drive in self._drives:
                self._watchdog.arm(self.bus, drive)
            self.armed = True
            # A drive begins to watch with the first sign of life that it hears.
            self._sign_of_life()
        self._walk(states.leads_to_enabled, DriveState.ENABLED)

    def _walk(self, leads: Callable[[DriveState, int], int], goal: DriveState) -> None:
        deadline = self._clock.now() + WALK_TIMEOUT_S * max(1.0, self._clock.rate)
        while not self._feedback.all_in(goal):
            seen = tuple(drive.statusword for drive in self._drives)
            with self.command:
                if self.stops and goal is DriveState.ENABLED:
                    raise Aborted(f"{self._name}: a stop is under way")
                left, right = (leads(d.state, word) for d, word in zip(self._drives, self._words, strict=True))
                self._words = left, right
                self.send_set_points()
            moved = partial(self._feedback.statuswords_other_than, seen)
            self._feedback.wait_for(moved, 0.0, self._alive, _STEP_WALL_S)
            self.bus.check()
            if what := self._feedback.disturbance:
                raise vehicle_fault(self._name, "vehicle.disturbed", what)
            if self._clock.now() > deadline:
                self._feedback.check(in_command=True, driving=False)
                shown = ", ".join(f"{d.side} {d.state.value} ({d.statusword:04X}h)" for d in self._drives)
                raise DeadlineError(
                    self._name,
                    f"the drives did not come to {goal.value} within {WALK_TIMEOUT_S:.0f} s: {shown}. See that the "
                    "power stages have voltage and the emergency stop is released",
                )

    def _prove_watchdog(self) -> None:
        """Hold our signs of life back, at speed 0: both drives have to leave operation by themselves."""
        begun = self._clock.now()
        longest = (self._watchdog.seconds + 1.0) * self._clock.rate
        self._mute = True
        try:
            while self._feedback.may_turn() and self._clock.now() - begun < longest:
                self._clock.wait(self._closed, _STEP_WALL_S * self._clock.rate)
                # By SDO: a drive that left the operational state tells nothing in PDOs.
                ask(self.bus, self._feedback, self._wheels)
        finally:
            self._mute = False
        took = self._clock.wall(self._clock.now() - begun)
        if self._feedback.may_turn():
            who = " and ".join(d.side for d in self._drives if states.may_turn(d.state))
            self._send_words(states.DISABLE_VOLTAGE)
            self._feedback.wait_for(partial(self._feedback.all_but, states.may_turn), WALK_TIMEOUT_S, self._alive)
            raise vehicle_fault(
                self._name,
                "vehicle.watchdog",
                f"without our heartbeat the {who} drive stays enabled, {took:.1f} s long (vehicle.watchdog is "
                f"{self._watchdog.seconds:g} s): it would drive on if this program died",
            )
        _log.info("%s: without our heartbeat the drives stopped after %.2f s", self._name, took)
        self._proved = True
        for drive in self._drives:
            self.bus.command(drive.node, od.START)

    def lock_brakes(self, *, locked: bool) -> None:
        """Switch brakes that hang on outputs; others follow the drives' states. A drive whose brake cannot be locked
        keeps no other one open: the first error is raised after all were tried."""
        if self._wheels.brake_output is None:
            return
        failed: list[CellError] = []
        for drive in self._drives:
            try:
                lock(self.bus, drive, self._wheels, locked=locked)
            except CellError as error:
                if not locked:
                    raise
                failed.append(error)
        if failed:
            raise failed[0]

    def end_operation(self) -> None:
        """Lock the brakes, end operation, and let drives that do not turn any more be left alone."""
        self.lock_brakes(locked=True)
        with self.command:
            left, right = (
                states.SWITCH_ON if drive.state is DriveState.ENABLED else word
                for drive, word in zip(self._drives, self._words, strict=True)
            )
            self._words = left, right
            self.send_set_points()
        ended = partial(self._feedback.all_but, states.may_turn)
        if not self._feedback.wait_for(ended, WALK_TIMEOUT_S, self._alive):
            self.bus.check()
            raise DeadlineError(
                self._name,
                f"a drive did not leave operation within {WALK_TIMEOUT_S:.0f} s, so its brake may be open. Press its "
                "emergency stop",
            )
        if self.armed:
            for drive in self._drives:
                self._watchdog.disarm(self.bus, drive)
            self.armed = False

    def set_velocity(self, speed: float, yaw_rate: float) -> None:
        """Keep this velocity, m/s and rad/s, until it is not renewed; the caller holds `command`."""
        self._velocity, self._renewed = (speed, yaw_rate), self._clock.now()
        self.send_set_points()

    def quick_stop(self, why: str) -> None:
        """Both drives, on the steep ramp; they have to be enabled again afterwards."""
        _log.warning("%s: quick stop: %s", self._name, why)
        self._statistics.count("quick_stop")
        self.enabled = False
        with self.command:
            for drive in self._drives:
                # A drive that another master took out of the operational state takes no PDO, but answers by SDO.
                self.bus.command(drive.node, od.START)
                self.bus.post(drive.node, od.CONTROLWORD, states.QUICK_STOP)
            self._send_words(states.QUICK_STOP)

    def _send_words(self, word: int) -> None:
        with self.command:
            self._velocity, self._words = (0.0, 0.0), (word, word)
            self.send_set_points()

    def send_set_points(self) -> None:
        """Both controlwords and target velocities; the caller holds `command`."""
        if self._velocity != (0.0, 0.0):
            self._feedback.commanded_to_move()
        halt = states.HALT if self.stops else 0
        targets = self._wheels.targets(*self._velocity)
        for drive, word, target in zip(self._drives, self._words, targets, strict=True):
            data = od.CONTROLWORD.pack(word | halt) + od.TARGET_VELOCITY.pack(target)
            self.bus.send(od.COMMAND + drive.node, data)

    def _keep(self) -> None:
        beat = -math.inf
        while not self._closed.wait(self._period()):
            with self.command:
                if not self.bus.alive:
                    continue
                try:
                    now = self._clock.now()
                    if not self._mute and self._clock.wall(now - beat) >= self._watchdog.period:
                        beat = now
                        self._sign_of_life()
                    self.bus.sync()
                    self._feedback.asked()
                    if self.enabled:
                        self._keep_driving(now)
                except CellError:
                    self._statistics.count("keep_alive_failed")

    def _period(self) -> float:
        seconds = SYNC_S if self.armed or not self._feedback.complete() else SYNC_AT_REST_S
        return max(self._clock.wall(seconds), _SYNC_WALL_S)

    def _keep_driving(self, now: float) -> None:
        if self._velocity != (0.0, 0.0) and now - self._renewed > DEAD_MAN_S:
            self._velocity = (0.0, 0.0)
            self._statistics.count("dead_man")
        if (fault := self._feedback.gave_up()) is not None:
            self.lost = fault
            self.quick_stop(fault.message)
        else:
            self.send_set_points()

    def _sign_of_life(self) -> None:
        if self._watchdog.guarding == "node":
            for drive in self._drives:
                self.bus.guard(drive.node)
        else:
            self.bus.send(od.HEARTBEAT + self._watchdog.own, bytes((od.OPERATIONAL,)))

    def _alive(self) -> bool:
        return self.bus.alive
