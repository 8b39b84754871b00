"""What the vehicle has reported last: waiting for news, its age, and the faults that it shows."""

from __future__ import annotations

import threading
from collections.abc import Callable

from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceFault
from drivers.interfaces import LinkStatistics, VehicleState
from drivers.vehicle.odometry import PlanarOdometry

CAN_MODE = 1
SILENCE_S = 0.5
"""Feedback that stays away for this long is a fault."""
WALL_FLOOR_S = 0.5
"""No patience with the vehicle is shorter than this on the wall, however fast the clock runs."""
CYCLIC = ("MotionState", "Odometry", "SystemState")
WANTED = frozenset({*CYCLIC, "VersionResponse"})
_FAST_AGE_WALL_S = 0.2
_SYSTEM_STATE_SLACK_S = 0.2
_OK, _EMERGENCY_STOP = 0, 1
_STILL = 0.002
"""Reported speeds up to this, m/s and rad/s, count as standstill: two steps of the protocol."""


def patience(clock: Clock, seconds: float) -> float:
    """`seconds` of the clock, or what the wall floor takes on this clock if that is longer."""
    return max(seconds, WALL_FLOOR_S * clock.rate)


class Feedback:
    """The newest messages by name, each with its host time; filled by the receive thread through `take`."""

    def __init__(self, name: str, clock: Clock, *, track: float, max_speed: float, statistics: LinkStatistics) -> None:
        self._name = name
        self._clock = clock
        self._max_speed = max_speed
        self._statistics = statistics
        self._odometry = PlanarOdometry(track)
        self._news = threading.Condition()
        self._newest: dict[str, tuple[float, dict[str, float]]] = {}

    def take(self, message: str, signals: dict[str, float]) -> None:
        """Keep a message that has just come in, and count odometry on."""
        now = self._clock.now()
        with self._news:
            if message == "Odometry":
                gap = now - self._newest[message][0] if message in self._newest else 0.0
                farthest = 0.5 + 2.0 * self._max_speed * gap
                if not self._odometry.update(int(signals["Left"]), int(signals["Right"]), farthest):
                    self._statistics.count("odometry_restarted")
            self._newest[message] = (now, signals)
            self._news.notify_all()

    def wait_for(self, happened: Callable[[], bool], timeout: float, alive: Callable[[], bool]) -> bool:
        """Wait until news make `happened` true, at most `timeout` s; False when they do not or `alive` turns false."""
        deadline = self._clock.now() + patience(self._clock, timeout)
        with self._news:
            while not happened():
                left = deadline - self._clock.now()
                if left <= 0.0 or not alive():
                    return False
                self._news.wait(min(self._clock.wall(left), 0.1))
        return True

    def complete(self) -> bool:
        """True once every cyclic message has come."""
        return all(message in self._newest for message in CYCLIC)

    def newer(self, message: str, time: float) -> bool:
        """True when `message` came after host time `time`."""
        return message in self._newest and self._newest[message][0] > time

    def get(self, message: str) -> tuple[float, dict[str, float]]:
        """Host time and signals of the newest `message`."""
        return self._newest[message]

    def commanded(self, since: float) -> bool:
        """True when the vehicle has reported CAN mode without fault after host time `since`."""
        system = self._newest["SystemState"][1]
        return self.newer("SystemState", since) and system["Mode"] == CAN_MODE and system["State"] == _OK

    def stands(self, since: float) -> bool:
        """True when the vehicle has reported standstill after host time `since`."""
        motion = self._newest["MotionState"][1]
        return self.newer("MotionState", since) and max(abs(motion["Speed"]), abs(motion["YawRate"])) <= _STILL

    def state(self, max_age: float, braked: bool) -> VehicleState:
        """All as one record; `DeadlineError` when it is older than `max_age` s.

        Vehicle state and voltage, which come every 0.1 s, may be 0.2 s older. On a clock that runs faster than the
        wall, no age below 0.2 s of the wall counts as old.
        """
        if self._clock.rate > 1.0:
            max_age = max(max_age, _FAST_AGE_WALL_S * self._clock.rate)
        with self._news:
            (moved, motion), (counted, _), (reported, system) = (self._newest[message] for message in CYCLIC)
            x, y, yaw = self._odometry.x, self._odometry.y, self._odometry.yaw
        age = self._clock.now() - min(moved, counted, reported + _SYSTEM_STATE_SLACK_S)
        if age > max_age:
            raise DeadlineError(
                self._name, f"the newest feedback is {age:.2f} s old, allowed {max_age:.2f} s. Check the CAN bus"
            )
        return VehicleState(
            stamp=min(moved, counted),
            x=x,
            y=y,
            yaw=yaw,
            speed=motion["Speed"],
            yaw_rate=motion["YawRate"],
            command_mode=system["Mode"] == CAN_MODE,
            braked=braked,
            emergency_stop=system["State"] == _EMERGENCY_STOP,
            error_bits=int(system["ErrorBits"]),
            battery_volts=round(system["BatteryVoltage"], 1),
        )

    def check(self) -> None:
        """Raise the `DeviceFault` that the feedback shows: vehicle.silent, vehicle.emergency_stop or vehicle.error."""
        with self._news:
            oldest = min(self._newest["SystemState"][0], self._newest["MotionState"][0])
            system = self._newest["SystemState"][1]
        silent = self._clock.now() - oldest
        if silent > patience(self._clock, SILENCE_S):
            raise DeviceFault(
                self._name,
                "vehicle.silent",
                f"no feedback for {silent:.2f} s",
                recoverable=True,
                hint="Check that the vehicle is on and the CAN bus is connected.",
            )
        if system["State"] == _EMERGENCY_STOP:
            raise DeviceFault(
                self._name,
                "vehicle.emergency_stop",
                "the emergency stop is pressed",
                recoverable=False,
                hint="Release the button when it is safe, then enable() the vehicle.",
            )
        if system["State"] != _OK:
            raise DeviceFault(
                self._name,
                "vehicle.error",
                f"reports an exception, error bits 0x{int(system['ErrorBits']):04x}",
                recoverable=True,
                hint="enable() clears errors whose cause is gone; else see the vehicle's manual for the bits.",
            )
