"""A skid-steered vehicle that speaks AgileX protocol v2 over CAN (docs/reference/protocols.md, section 3).

The set velocity is kept alive by a thread of the driver, which falls back to zero when nobody renews it; the vehicle
itself stops 0.5 s after the last command. Brake feedback is not on the bus: `braked` is what was commanded last. It is
None before this driver has commanded it, outside CAN mode, when an adapter has refused the command, or when somebody
else may have changed it since.
"""

import logging
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from drivers.clock import Clock, timeout_of
from drivers.errors import (
    Aborted,
    CellError,
    DeadlineError,
    DeviceFault,
    InterlockError,
    NotConnectedError,
    check_range,
)
from drivers.interfaces import Identity, LinkStatistics, Reading, VehicleState
from drivers.vehicle import health
from drivers.vehicle.agilex_link import TEXT_REQUEST, UNKNOWN, AgilexLink, load_database
from drivers.vehicle.can_link import REFUSED
from drivers.vehicle.faults import OUT_OF_COMMAND
from drivers.vehicle.feedback import CAN_MODE, CYCLIC, WANTED, MessageFeedback
from drivers.vehicle.health import can_interface

KEEP_ALIVE_S = 0.020
DEAD_MAN_S = 0.5
"""A velocity that has not been renewed for this long is replaced by zero."""
STOP_TIMEOUT_S = 4.0
ENABLE_TIMEOUT_S = 2.0
REPLY_TIMEOUT_S = 0.5
FIRST_FEEDBACK_S = 1.0
LOCKS = 3
"""So often the brake's lock is sent: an adapter may refuse a frame or two."""
_ENABLE_RETRY_S = 0.3
_KEEP_ALIVE_WALL_S = 0.005

_log = logging.getLogger(__name__)


class AgilexVehicle:
    """A vehicle on the python-can bus (`interface`, `channel`).

    `track` in m between left and right wheels, effective for turning on the spot; `max_speed` in m/s, `max_yaw_rate`
    in rad/s. Raises `NotConnectedError` when no vehicle reports on the bus.
    """

    def __init__(
        self, name: str, interface: str, channel: str, *, bitrate: int = 500_000, track: float, max_speed: float,
        max_yaw_rate: float, clock: Clock,
    ) -> None:  # fmt: skip
        self.name = name
        self.statistics = LinkStatistics()
        self._address = f"{interface}:{channel}"
        self._bitrate, self._database = bitrate, load_database()
        self._system_name = channel if interface == "socketcan" else None
        self._max_speed = max_speed
        self._max_yaw_rate = max_yaw_rate
        self._clock = clock
        self._feedback = MessageFeedback(
            name, clock, track=track, max_speed=max_speed, max_yaw_rate=max_yaw_rate, statistics=self.statistics
        )
        self._command = threading.Lock()
        self._velocity = (0.0, 0.0)
        self._renewed = -math.inf
        self._enabled = self._took_command = False
        self._braked: bool | None = None
        self._interruptions: int | None = 0
        """How many there had been when the brake was commanded: one more, and it may have been released since. None
        outside CAN mode, where it may not have been obeyed."""
        self._refused_before = 0
        """How many frames had been refused when the lock was sent."""
        self._lock_refused = False
        self._stopping = 0
        self._ends = 0
        self._alarms = 0
        """Those of others on the bus that this program has answered by the brake."""
        self._closed = threading.Event()
        self._open = partial(
            AgilexLink, name, interface, channel, bitrate=bitrate,
            database=self._database, wanted=WANTED, told=self._feedback.take, idle=self._feedback.idle,
            statistics=self.statistics,
        )  # fmt: skip
        self._link = self._open()
        try:
            self._require_vehicle()
        except BaseException:
            self._link.close()
            raise
        self._keeper = threading.Thread(target=self._keep_alive, name=f"{name} keep-alive", daemon=True)
        self._keeper.start()

    def identity(self) -> Identity:
        """The protocol has no serial number; a version that is not told is "unknown"."""
        for ask in (
            partial(self._link.send_data, *TEXT_REQUEST),
            partial(self._link.send, "VersionRequest", Request=1),
        ):
            answer = self._feedback.ask_version()
            ask()
            if self._wait_for(answer.is_complete, REPLY_TIMEOUT_S):
                return Identity("AgileX v2", "", answer.describe(), self._address)
        self._link.check()
        _log.info("%s: answers no version request; its version is unknown, which is no fault", self.name)
        return Identity("AgileX v2", "", UNKNOWN, self._address)

    def ping(self) -> float:
        """How long, in wall seconds, until it tells its motion next, which it does every 20 ms. Nothing on the bus is
        answered by every model. Raises `DeadlineError` when nothing comes."""
        before = self._clock.now()
        if not self._wait_for(partial(self._feedback.newer, "MotionState", before), REPLY_TIMEOUT_S):
            self._link.check()
            self.statistics.count("timeouts")
            raise DeadlineError(self.name, f"tells nothing for {REPLY_TIMEOUT_S} s. Check the CAN bus")
        taken = self._clock.wall(self._feedback.get("MotionState")[0] - before)
        self.statistics.add_round_trip(taken)
        return taken

    def examine(self, seconds: float) -> list[Reading]:
        """How the bus is used in `seconds`, how evenly the vehicle tells, and what; see `drivers.vehicle.health`."""
        with self._link.listening() as frames:
            self._clock.wait(self._closed, seconds)
        self._link.check()
        heard = [(stamp * self._clock.rate, frame) for stamp, frame in frames]
        interface = None if self._system_name is None else can_interface(self._system_name)
        judged = self._clock.rate <= 1.0
        return health.readings(heard, seconds, self._bitrate, self._database, interface=interface, judge_times=judged)

    def state(self, max_age: float = 0.2) -> VehicleState:
        """The newest feedback, at most `max_age` s old (see `MessageFeedback.state`), else `DeadlineError`."""
        self._link.check()
        state = self._feedback.state(max_age, self._braked)
        refused = self._braked and (self._lock_refused or self._refused() >= LOCKS)
        sure = not refused and state.command_mode and state.interruptions == self._interruptions
        return state if sure else replace(state, braked=None)

    def check(self) -> None:
        """Raise the `DeviceFault` that the vehicle shows now; see `MessageFeedback.check`. Returns at once otherwise.
        One that somebody else commands or moves is out of command from then on, until it is enabled again."""
        self._check(driving=False)

    def _check(self, driving: bool) -> None:
        self._link.check()
        try:
            self._feedback.check(in_command=self._enabled, driving=driving)
        except DeviceFault as fault:
            if fault.code in OUT_OF_COMMAND:
                with self._command:
                    if self._enabled and self._feedback.alarms != self._alarms:
                        self._brake_against_others()
                    self._enabled = False
            raise

    def enable(self) -> None:
        """Take command over CAN and release the brake; opens the bus again if it had failed. Raises `DeviceFault` on an
        emergency stop or an error that does not clear, `DeadlineError` when the vehicle does not change to CAN mode."""
        ends = self._ends
        self._take_command()
        with self._command:
            if self._ends != ends:
                self._enabled = False
                raise Aborted(f"{self.name}: it was stopped while it was enabled")
            self._link.send("BrakeCommand", Locked=0)
            self._braked, self._interruptions = False, self._feedback.interruptions

    def recover(self) -> None:
        """As `enable`, but with the brake locked throughout: the vehicle stays where it was measured."""
        self._take_command()
        self.brake()

    def _require_vehicle(self) -> None:
        if not self._wait_for(self._feedback.complete, FIRST_FEEDBACK_S):
            missing, malformed = self._feedback.missing(), self.statistics.errors.get("malformed", 0)
            heard = f" completely: {', '.join(missing)} did not come" if len(missing) < len(CYCLIC) else ""
            if malformed:
                heard += f"; {malformed} frames had another length than in the protocol"
            raise NotConnectedError(
                self.name, f"no vehicle reports on {self._address}{heard}. Check that it is on, and the bit rate"
            )

    def _take_command(self) -> None:
        if self._closed.is_set():
            raise NotConnectedError(self.name, "the vehicle was closed. Open it again")
        with self._command:
            self._velocity = (0.0, 0.0)
            self._enabled = False
            if not self._link.alive:
                self._link.close()
                self._link = self._open()
                self.statistics.count("reopened")
                self._feedback.interrupt("the CAN bus failed and was opened again")
            self._alarms = self._feedback.alarms
        self._feedback.acknowledge()
        deadline = self._clock.now() + timeout_of(self._clock, ENABLE_TIMEOUT_S)
        while True:
            asked = self._clock.now()
            self._link.send("ClearErrorsCommand", Which=0)
            self._link.send("ControlModeCommand", Mode=CAN_MODE)
            # Standing still is a command as well: a vehicle that misses commands reports that as an error.
            with self._command:
                self._send_velocity()
            if self._wait_for(partial(self._feedback.commanded, asked), _ENABLE_RETRY_S):
                break
            if self._clock.now() > deadline:
                self._feedback.check(in_command=False, driving=True)
                raise DeadlineError(
                    self.name,
                    f"did not change to CAN mode within {ENABLE_TIMEOUT_S:.0f} s. Is the remote control in charge?",
                )
        self._feedback.require_one()
        with self._command:
            self._enabled = self._took_command = True

    def drive(self, speed: float, yaw_rate: float) -> None:
        """Set the velocity, m/s and rad/s; must be renewed within 0.5 s or it becomes zero. Raises `LimitError`,
        `InterlockError` before `enable()`, `DeviceFault` as `check` does, `Aborted` while a stop is under way."""
        speed = check_range(self.name, "speed", speed, low=-self._max_speed, high=self._max_speed, unit="m/s")
        yaw_rate = check_range(self.name, "yaw rate", yaw_rate, -self._max_yaw_rate, self._max_yaw_rate, unit="rad/s")
        self._link.require_unspoken()
        self._check(driving=True)
        with self._command:
            if self._stopping:
                raise Aborted(f"{self.name}: a stop is under way")
            enabled = self._enabled
            if enabled and not self._braked:
                self._velocity = (speed, yaw_rate)
                self._renewed = self._clock.now()
                self._send_velocity()
                return
        if enabled:
            # It may have been braked against another's commands since the check above: then that is the fault.
            self.check()
        reason = "the brake is locked" if enabled else "it is not under CAN command"
        raise InterlockError(self.name, f"{reason}, so it would not move. Call enable() first")

    def stop(self) -> None:
        """Command zero at once and wait until the vehicle reports standstill; `DeadlineError` after 4 s. With feedback
        of two vehicles nobody knows: `DeviceFault`."""
        with self._command:
            self._velocity = (0.0, 0.0)
            self._stopping += 1
            self._ends += 1
        try:
            asked = self._clock.now()
            with self._command:
                self._send_velocity()
            if not self._wait_for(partial(self._feedback.stands_or_contradicts, asked), STOP_TIMEOUT_S):
                self._link.check()
                raise DeadlineError(
                    self.name,
                    f"did not report standstill within {STOP_TIMEOUT_S:.0f} s of the stop. Press its emergency stop",
                )
            self._feedback.require_one()
        finally:
            with self._command:
                self._stopping -= 1

    def brake(self) -> None:
        """Stop, wait for standstill and lock the brake; it stays locked until `enable()`.

        The brake is locked also when standstill is not reported in time, which is raised afterwards. While somebody
        else commands the vehicle it is locked first: it would not come to a standstill.
        """
        with self._command:
            self._stopping += 1
        try:
            with self._command:
                if self._feedback.contested:
                    self._brake_against_others()
            self.stop()
        finally:
            # No drive() between the standstill and the brake.
            with self._command:
                in_command = self._feedback.get("SystemState")[1]["Mode"] == CAN_MODE
                self._braked, self._interruptions = True, self._feedback.interruptions if in_command else None
                self._stopping -= 1
                self._send_locks()

    def close(self) -> None:
        """Stop the vehicle and lock its brake, end the threads and shut the bus down."""
        if self._closed.is_set():
            return
        try:
            # Whoever never commanded it has nothing to end, and another may be driving it.
            if self._took_command:
                self.brake()
        finally:
            self._closed.set()
            self._keeper.join(2.0)
            self._link.close()

    def _keep_alive(self) -> None:
        period = max(self._clock.wall(KEEP_ALIVE_S), _KEEP_ALIVE_WALL_S)
        while not self._closed.wait(period):
            with self._command:
                if self._velocity != (0.0, 0.0) and self._clock.now() - self._renewed > DEAD_MAN_S:
                    self._velocity = (0.0, 0.0)
                    self.statistics.count("dead_man")
                if (self._enabled or self._stopping) and self._link.alive:
                    try:
                        if self._feedback.alarms != self._alarms:
                            self._brake_against_others()
                        elif self._enabled:
                            self._send_velocity()
                            if self._braked:
                                self._repeat_refused_locks()
                    except CellError:
                        self.statistics.count("keep_alive_failed")

    def _brake_against_others(self) -> None:
        """Lock the brake at once, holding `_command`: against another's commands no zero leads to a standstill. `state`
        tells of an unknown brake until `brake` or `enable`: another may have released it again."""
        self._velocity, self._braked = (0.0, 0.0), True
        self._alarms = self._feedback.alarms
        self._send_velocity()
        self._send_locks()
        self.statistics.count("braked_against_others")

    def _repeat_refused_locks(self) -> None:
        """Send the lock again if one may have been refused, holding `_command`; see what became of those before."""
        refused = self._refused()
        self._lock_refused = refused >= LOCKS
        if refused:
            self._send_locks()

    def _send_locks(self) -> None:
        self._refused_before = self.statistics.errors.get(REFUSED, 0)
        for _ in range(LOCKS):
            self._link.send("BrakeCommand", Locked=1)

    def _refused(self) -> int:
        """Frames that were refused since the lock was sent: fewer than `LOCKS`, and at least one lock was taken."""
        return self.statistics.errors.get(REFUSED, 0) - self._refused_before

    def _send_velocity(self) -> None:
        """Send the set velocity, holding `_command`: else an older velocity could follow the zero of a stop."""
        speed, yaw_rate = self._velocity
        if self._velocity != (0.0, 0.0):
            self._feedback.commanded_to_move()
        self._link.send("MotionCommand", Speed=speed, YawRate=yaw_rate, LateralSpeed=0.0, Steering=0.0)

    def _wait_for(self, happened: Callable[[], bool], timeout: float) -> bool:
        return self._feedback.wait_for(happened, timeout, lambda: self._link.alive)
