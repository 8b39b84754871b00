"""What the vehicle has reported last, its age, and the faults that it shows; odometry from the distances of its two
sides, and when that no longer tells where the vehicle is."""

import math
import threading
from collections import deque
from collections.abc import Callable

from drivers.clock import WALL_FLOOR_S, Clock, timeout_of
from drivers.errors import DeadlineError
from drivers.interfaces import LinkStatistics, VehicleState
from drivers.vehicle.agilex_link import ANSWERS, VersionAnswer
from drivers.vehicle.faults import (
    driver_trouble,
    system_trouble,
    system_warnings,
    two_vehicles,
    vehicle_error,
    vehicle_fault,
)

_SPAN = 1 << 32
_HALF = 1 << 31


class PlanarOdometry:
    """Integrates the left and right odometers, signed 32-bit counters of `unit` m, for wheels `track` m apart. `x`, `y`
    in m and `yaw` in rad in the frame where the vehicle stood at the first reading."""

    def __init__(self, track: float, unit: float = 1e-3) -> None:
        self._track = track
        self._unit = unit
        self._last: tuple[int, int] | None = None
        self.x = 0.0
        self.y = 0.0
        self.yaw = 0.0

    def update(self, left: int, right: int, farthest: float) -> bool:
        """Take a reading; the counters may wrap. False when a side has jumped by more than `farthest` m: the vehicle
        was restarted, and counting goes on from this reading without the jump."""
        last, self._last = self._last, (left, right)
        if last is None:
            return True
        way_left, way_right = (self._unit * difference(new, old) for new, old in zip((left, right), last, strict=True))
        if max(abs(way_left), abs(way_right)) > farthest:
            return False
        way = 0.5 * (way_left + way_right)
        turn = (way_right - way_left) / self._track
        # Along an arc the chord points half the turn further than the heading before it.
        self.x += way * math.cos(self.yaw + 0.5 * turn)
        self.y += way * math.sin(self.yaw + 0.5 * turn)
        self.yaw += turn
        return True


def difference(new: int, old: int) -> int:
    """Counts from `old` to `new`, the shorter way round of a counter of 32 bits."""
    return (new - old + _HALF) % _SPAN - _HALF


REST_AFTER_S = 4.0
"""After its last command to move the vehicle stands within this."""
STANDS_M = 0.005
"""A side that counts more than this without a command has been moved by somebody else."""
_JUMP_M = 0.05
"""What a side may count from one reading to the next besides what it can have driven: readings come in bursts."""
_SWING_M = 0.003
"""A side that counts more than this ahead and as much back from one reading to the next makes a swing."""
SWINGS = 3
"""So many swings within `_SWINGS_S` are two vehicles: no wheel turns back and forth at 20 ms."""
_SWINGS_S = 0.5


class Travel:
    """Odometry of two sides whose counters are signed 32-bit numbers of `unit` m, and what interrupted it.

    `disturbance` says how somebody else moved or commanded the vehicle, until `acknowledge`; `alarms` counts how often
    that happened. Not safe between threads: whoever holds it locks.
    """

    def __init__(
        self, clock: Clock, statistics: LinkStatistics, *, track: float, max_speed: float, max_yaw_rate: float,
        unit: float = 1e-3,
    ) -> None:  # fmt: skip
        self._clock = clock
        self._statistics = statistics
        self._unit = unit
        self._side_speed = max_speed + 0.5 * track * max_yaw_rate
        self._commanded = -math.inf
        self._rest: tuple[int, int] | None = None
        self._counted = math.nan
        self.odometry = PlanarOdometry(track, unit)
        self.interruptions = 0
        """How often odometry lost its connection to where the vehicle was before."""
        self.interruption = ""
        """Why it did last."""
        self.disturbance = ""
        self.two_vehicles = ""
        """How the counts show two vehicles under the same identifiers; kept until it has passed and is acknowledged."""
        self.alarms = 0
        self._counts: tuple[int, int] | None = None
        self._ways = (0, 0)
        self._swings: deque[float] = deque(maxlen=SWINGS)

    @property
    def driven(self) -> bool:
        """Whether the vehicle may still move by a command of this program."""
        return self._clock.now() - self._commanded < REST_AFTER_S

    def commanded_to_move(self) -> None:
        """A velocity was just sent: what moves for the next `REST_AFTER_S` moves by that."""
        self._commanded = self._clock.now()

    def acknowledge(self) -> None:
        """Whoever takes command now has heard of what others did before."""
        self.disturbance, self._rest = "", None
        if not self.swings():
            self.two_vehicles = ""

    def interrupt(self, why: str) -> None:
        """From now on odometry does not tell where the vehicle is relative to where it was before."""
        self.interruptions += 1
        self.interruption = why

    def disturb(self, what: str) -> None:
        """Somebody else commands or moves the vehicle."""
        self.disturbance = what
        self.alarms += 1
        self.interrupt(what)

    def _look_for_swings(self, now: float, left: int, right: int) -> None:
        last, self._counts = self._counts or (left, right), (left, right)
        ways = (difference(left, last[0]), difference(right, last[1]))
        swings = (
            b * a < 0 and min(abs(b), abs(a)) * self._unit > _SWING_M for a, b in zip(ways, self._ways, strict=True)
        )
        if any(swings):
            self._swings.append(now)
            if self.swings() and not self.two_vehicles:
                first, second = (
                    [f"{1e3 * self._unit * count:.0f}" for count in counts] for counts in (last, self._counts)
                )
                self.two_vehicles = (
                    f"the odometers jump between two series of counts, left and right {' and '.join(first)} mm, then "
                    f"{' and '.join(second)} mm: two vehicles report under the same identifiers"
                )
                self.alarms += 1
                self.interrupt(self.two_vehicles)
        if any(ways):
            self._ways = ways

    def swings(self) -> bool:
        """Whether the counts of two vehicles come at present."""
        recent = self._clock.now() - _SWINGS_S * max(1.0, self._clock.rate)
        return len(self._swings) == SWINGS and self._swings[0] > recent

    def count(self, now: float, left: int, right: int) -> None:
        """Take a reading of both counters at host time `now`."""
        self._look_for_swings(now, left, right)
        before = now if math.isnan(self._counted) else self._counted
        self._counted = now
        # It has driven no longer than since its last reading, and only until it came to rest after its last command.
        driven = max(0.0, min(now, self._commanded + REST_AFTER_S) - before)
        if not self.odometry.update(left, right, _JUMP_M + self._side_speed * driven):
            self._statistics.count("odometry_restarted")
            self.interrupt("its odometers jumped, so it was restarted")
        if now - self._commanded < REST_AFTER_S:
            self._rest = None
        elif self._rest is None:
            self._rest = (left, right)
        elif (moved := self._unit * max(map(abs, map(difference, (left, right), self._rest)))) > STANDS_M:
            self.disturb(f"it moved by {1e3 * moved:.0f} mm without a command")
            self._rest = (left, right)


CAN_MODE = 1
SILENCE_S = 0.5
"""Feedback that stays away for this long is a fault."""
QUIET_S = 2.0
"""A vehicle that nothing was heard of for this long, on the wall, while this program did listen, may have been
restarted meanwhile: its odometry no longer tells where it is."""
CYCLIC = ("MotionState", "Odometry", "SystemState")
_DRIVERS = {f"MotorDriver{motor}": motor for motor in range(1, 9)}
_COMMANDS = ("MotionCommand", "BrakeCommand")
WANTED = frozenset({*CYCLIC, *_DRIVERS, *_COMMANDS, *ANSWERS})
"""The vehicle's messages, and the commands of others on the bus; one's own do not come back."""
FAST_AGE_WALL_S = 0.2
_SYSTEM_STATE_SLACK_S = 0.2
_OK, _EMERGENCY_STOP = 0, 1
STILL = 0.0035
"""Reported speeds up to this, m/s and rad/s, count as standstill: at rest they waver by three steps of the protocol."""

STILL_FRAMES = 4
"""A stop is confirmed by so many frames in a row that all say so: of two vehicles that report, one may stand."""
_CREPT = 2
"""Counts in mm that an odometer may go on while the speed says standstill: one of noise, one of rounding."""


class Feedback:
    """What a vehicle tells, taken by the receive thread under the lock `_news`, and how far its wheels have turned."""

    def __init__(self, name: str, clock: Clock, travel: Travel) -> None:
        self._name = name
        self._clock = clock
        self._travel = travel
        self._news = threading.Condition(threading.RLock())

    def commanded_to_move(self) -> None:
        """The driver has just sent a velocity."""
        with self._news:
            self._travel.commanded_to_move()

    def interrupt(self, why: str) -> None:
        """From now on odometry does not tell where the vehicle is relative to where it was before."""
        with self._news:
            self._travel.interrupt(why)

    @property
    def interruptions(self) -> int:
        """How often odometry lost its connection to where the vehicle was before."""
        with self._news:
            return self._travel.interruptions

    def require_one(self) -> None:
        """Raise the `DeviceFault` of two vehicles that report under the same identifiers."""
        with self._news:
            if what := self._travel.two_vehicles:
                raise two_vehicles(self._name, what)

    def acknowledge(self) -> None:
        """Whoever takes command now has heard of what others did before."""
        with self._news:
            self._travel.acknowledge()

    def wait_for(
        self, happened: Callable[[], bool], timeout: float, alive: Callable[[], bool], floor: float = WALL_FLOOR_S
    ) -> bool:
        """Wait until news make `happened` true; False when they do not or `alive` turns false. At most `timeout` s, or
        `floor` s on the wall if that is longer."""
        deadline = self._clock.now() + max(timeout, floor * self._clock.rate)
        with self._news:
            while not happened():
                left = deadline - self._clock.now()
                if left <= 0.0 or not alive():
                    return False
                self._news.wait(min(self._clock.wall(left), 0.1))
        return True

    def _require_young(self, told: float, max_age: float) -> None:
        """`DeadlineError` when what was told at host time `told` is older than `max_age` s. On a clock that runs faster
        than the wall, no age below 0.2 s of the wall counts as old."""
        if self._clock.rate > 1.0:
            max_age = max(max_age, FAST_AGE_WALL_S * self._clock.rate)
        age = self._clock.now() - told
        if age > max_age:
            raise DeadlineError(
                self._name, f"the newest feedback is {age:.2f} s old, allowed {max_age:.2f} s. Check the CAN bus"
            )


class MessageFeedback(Feedback):
    """The newest messages by name, each with its host time; filled by the receive thread through `take`."""

    def __init__(
        self, name: str, clock: Clock, *, track: float, max_speed: float, max_yaw_rate: float,
        statistics: LinkStatistics,
    ) -> None:  # fmt: skip
        travel = Travel(clock, statistics, track=track, max_speed=max_speed, max_yaw_rate=max_yaw_rate)
        super().__init__(name, clock, travel)
        self._newest: dict[str, tuple[float, dict[str, float]]] = {}
        self._quiet = dict.fromkeys(CYCLIC, 0.0)
        """Wall seconds for which the receiver has waited since each of them came."""
        self._version = VersionAnswer()
        self._still = 0
        """Frames in a row that say standstill."""
        self._still_at: tuple[float, float] | None = None

    def take(self, message: str, signals: dict[str, float]) -> None:
        """Keep a message that has just come in, and count odometry on."""
        now = self._clock.now()
        with self._news:
            if message in CYCLIC:
                if (quiet := min(self._quiet.values())) > QUIET_S:
                    self.interrupt(f"nothing was heard of it for {quiet:.1f} s")
                self._quiet[message] = 0.0
            if message == "Odometry":
                self._travel.count(now, int(signals["Left"]), int(signals["Right"]))
                self._compare_counts((signals["Left"], signals["Right"]))
            elif message == "MotionState":
                if max(abs(signals["Speed"]), abs(signals["YawRate"])) <= STILL:
                    self._still += 1
                else:
                    self._still, self._still_at = 0, None
            elif message == "MotionCommand" and (signals["Speed"] or signals["YawRate"]):
                self._travel.disturb("somebody else on the CAN bus commands it to move")
            elif message == "BrakeCommand" and not signals["Locked"]:
                self._travel.disturb("somebody else on the CAN bus released its brake")
            elif message in ANSWERS:
                self._version.take(message, signals)
            self._newest[message] = (now, signals)
            self._news.notify_all()

    def _compare_counts(self, counts: tuple[float, float]) -> None:
        """Wheels that count on do not stand, whatever the speed says."""
        self._still_at = self._still_at or counts
        if max(abs(difference(int(a), int(b))) for a, b in zip(counts, self._still_at, strict=True)) > _CREPT:
            self._still, self._still_at = 0, counts

    def idle(self, seconds: float) -> None:
        """The receiver has waited for `seconds` on the wall; what came then may have been another's."""
        with self._news:
            for message in CYCLIC:
                self._quiet[message] += seconds

    @property
    def alarms(self) -> int:
        """How often somebody else commanded or moved the vehicle, or was taken for it."""
        with self._news:
            return self._travel.alarms

    @property
    def contested(self) -> bool:
        """Whether somebody else commands or moves the vehicle, or is taken for it, and nobody has acknowledged that."""
        with self._news:
            return bool(self._travel.disturbance or self._travel.two_vehicles)

    def _trouble(self, *, commanded: bool) -> tuple[str, ...]:
        found = list(system_trouble(int(self._newest["SystemState"][1]["ErrorBits"]), commanded=commanded))
        for message, motor in _DRIVERS.items():
            if message in self._newest:
                found += driver_trouble(motor, int(self._newest[message][1]["DriverStatus"]))
        return tuple(found)

    def complete(self) -> bool:
        """True once every cyclic message has come."""
        return all(message in self._newest for message in CYCLIC)

    def missing(self) -> tuple[str, ...]:
        """The cyclic messages that have not come yet."""
        return tuple(message for message in CYCLIC if message not in self._newest)

    def ask_version(self) -> VersionAnswer:
        """A new answer to be filled by what comes from now on."""
        with self._news:
            self._version = VersionAnswer()
            return self._version

    def newer(self, message: str, time: float) -> bool:
        """True when `message` came after host time `time`."""
        return message in self._newest and self._newest[message][0] > time

    def get(self, message: str) -> tuple[float, dict[str, float]]:
        """Host time and signals of the newest `message`."""
        return self._newest[message]

    def commanded(self, since: float) -> bool:
        """True when the vehicle has reported CAN mode without fault after host time `since`."""
        system = self._newest["SystemState"][1]
        fit = system["State"] == _OK and not self._trouble(commanded=False)
        return self.newer("SystemState", since) and system["Mode"] == CAN_MODE and fit

    def stands(self, since: float) -> bool:
        """True when the vehicle has reported standstill after host time `since`, and nothing contradicts that."""
        news = self.newer("MotionState", since) and self.newer("Odometry", since)
        return news and self._still >= STILL_FRAMES

    def stands_or_contradicts(self, since: float) -> bool:
        """As `stands`; True also when two vehicles report, of which nobody can tell."""
        return bool(self._travel.two_vehicles) or self.stands(since)

    def state(self, max_age: float, braked: bool | None) -> VehicleState:
        """All as one record; `DeadlineError` when it is older than `max_age` s. Vehicle state and voltage, which come
        every 0.1 s, may be 0.2 s older; see `_require_young`."""
        with self._news:
            (moved, motion), (counted, _), (reported, system) = (self._newest[message] for message in CYCLIC)
            travel = self._travel
            x, y, yaw = travel.odometry.x, travel.odometry.y, travel.odometry.yaw
            interruptions, interruption = travel.interruptions, travel.interruption
            trouble = self._trouble(commanded=True)
        self._require_young(min(moved, counted, reported + _SYSTEM_STATE_SLACK_S), max_age)
        return VehicleState(
            stamp=min(moved, counted), x=x, y=y, yaw=yaw, speed=motion["Speed"], yaw_rate=motion["YawRate"],
            command_mode=system["Mode"] == CAN_MODE, braked=braked, emergency_stop=system["State"] == _EMERGENCY_STOP,
            error_bits=int(system["ErrorBits"]), battery_volts=round(system["BatteryVoltage"], 1), trouble=trouble,
            warnings=system_warnings(int(system["ErrorBits"])), interruptions=interruptions, interruption=interruption,
        )  # fmt: skip

    def check(self, *, in_command: bool, driving: bool) -> None:
        """Raise the `DeviceFault` that the feedback shows: vehicle.two_vehicles, vehicle.silent,
        vehicle.emergency_stop, vehicle.error.

        With `in_command` also vehicle.command_lost and vehicle.disturbed: nobody else may command what this program
        has enabled. One who is `driving` must have heard of it lately. For a vehicle that stands it is enough that the
        receiver does not wait in vain: a program that computes reads late.
        """
        with self._news:
            oldest, which = min((self._newest[message][0], message) for message in CYCLIC)
            system, disturbance = self._newest["SystemState"][1], self._travel.disturbance
            trouble = self._trouble(commanded=in_command)
            quiet = max(self._quiet.values())
            self.require_one()
        silent = self._clock.now() - oldest
        if silent > timeout_of(self._clock, SILENCE_S) if driving else quiet > QUIET_S:
            raise vehicle_fault(
                self._name, "vehicle.silent", f"no feedback for {silent:.2f} s ({which} came last before that)"
            )
        if system["State"] == _EMERGENCY_STOP:
            raise vehicle_fault(self._name, "vehicle.emergency_stop")
        if system["State"] != _OK or trouble:
            raise vehicle_error(self._name, int(system["ErrorBits"]), trouble, driven=self._travel.driven)
        if in_command and system["Mode"] != CAN_MODE:
            self.interrupt("it left CAN command")
            raise vehicle_fault(
                self._name,
                "vehicle.command_lost",
                f"left CAN command (mode {int(system['Mode'])}): somebody took the remote control, or it was restarted",
            )
        if in_command and disturbance:
            raise vehicle_fault(self._name, "vehicle.disturbed", disturbance)
