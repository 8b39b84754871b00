"""The newest state of the arm, and waiting for one that is fresh or that shows something.

What the arm driver and its child process say to each other over their pipe, pickled.

The driver sends one `ChildSetup`, then `ChildRequest`s; the child answers each with a `ChildReply` and sends
`Snapshot`s, `Ended` and `Lost` by itself. Positions in m and rad, forces in N, times in s of the system's monotonic
clock, which all processes share."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from drivers.clock import Clock
from drivers.errors import DeadlineError, shown
from drivers.interfaces import LinkStatistics

Six = tuple[float, ...]
"""Six numbers: joints in rad, or a pose (x, y, z, rotation vector)."""


@dataclass(frozen=True)
class ChildSetup:
    """How the child works: `rate` is the clock's, `safe_off` the outputs to switch off when the owner is lost.

    `payload` is mass in kg and centre of gravity in the flange frame in m. The controller ends its program when it
    hears nothing for `watchdog` seconds on the wall. `braking` is the deceleration of a stop in rad/s². Without
    `control` the arm is only looked at: nothing is set, started or ended. `model` is the name that the controller has
    to tell, any where it is empty.
    """

    address: str
    rate: float
    safe_off: tuple[int, ...]
    payload: tuple[float, tuple[float, float, float]]
    watchdog: float
    braking: float
    control: bool = True
    model: str = ""


@dataclass(frozen=True)
class ChildRequest:
    """Do `name` with `arguments`.

    Names: stop, close, output, safe_off, alive, attend, payload, zero_force, move_joints, move_linear, follow. `alive`
    is the owner's sign of life (`Pulse`). `attend` with wall seconds: from now on what moves is stopped unless this is
    said again within them; 0 ends that.
    """

    number: int
    name: str
    arguments: tuple[Any, ...] = ()


UNANSWERED = -1
"""The number of a request whose reply nobody waits for."""


@dataclass(frozen=True)
class ChildReply:
    """The request was carried out, or `problem` says (code, text) why not. Number 0 tells that the child is up."""

    number: int
    problem: tuple[str, str] | None = None


@dataclass(frozen=True)
class Snapshot:
    """One state packet of the arm; `stamp` is when it arrived, `device_time` in s when the controller measured it, on
    the controller's own clock.

    `safety_bits`, `mode` and `runtime`, the state of the program, as the controller reports them; `wrench` at the
    flange in base axes; `late` by how many s at most what the arm was told came late, before it stopped for safety;
    `payload` is what the controller reckons with, kg and centre of gravity in the flange in m.
    """

    stamp: float
    joints: Six
    speeds: Six
    flange: Six
    wrench: Six
    safety_bits: int
    mode: int
    runtime: int
    inputs: int
    outputs: int
    device_time: float = 0.0
    late: float = 0.0
    payload: tuple[float, Six] = (0.0, (0.0, 0.0, 0.0))

    @property
    def program_running(self) -> bool:
        """True while a program runs; one that is paused does not."""
        return self.runtime == PLAYING

    @property
    def at_rest(self) -> bool:
        """True while the arm stands still."""
        return max(abs(speed) for speed in self.speeds) < AT_REST


@dataclass(frozen=True)
class StreamTiming:
    """How regularly the points of a trajectory went out: their number, their rate in Hz, and the time between two, in s
    on the wall: median, 99 % and longest."""

    points: int
    rate: float
    median: float
    p99: float
    longest: float


@dataclass(frozen=True)
class Ended:
    """The motion is over: `how` is arrived, contact, stopped, or the code of a fault with its `text`. `pace` is that of
    a trajectory's points."""

    motion: int
    how: str
    text: str = ""
    pace: StreamTiming | None = None


@dataclass(frozen=True)
class Lost:
    """The child has lost the arm and ends."""

    text: str


STOPPED, PLAYING = 1, 2
"""`Snapshot.runtime` without a program, and while one runs; others are between the two, or paused."""

MODE_RUNNING = 7
"""`Snapshot.mode` of an arm whose joints are powered and whose brakes are released."""

AT_REST = 0.003
"""An arm whose joints all turn slower than this, in rad/s, stands still."""

_SAFETY_CODES = (
    (0b0000_1110_0000, "arm.emergency_stop"),
    (0b0011_0000_0000, "arm.safety_fault"),
    (0b0000_0000_0100, "arm.protective_stop"),
    (0b0000_0000_1000, "arm.recovery_mode"),
    (0b0000_0001_0000, "arm.safeguard_stop"),
    # Stopped for safety by none of these: a three-position switch that was let go.
    (0b0100_0000_0000, "arm.safeguard_stop"),
)


def safety_code(bits: int) -> str:
    """The fault code for the controller's safety status bits, the gravest first; empty when all is normal."""
    return next((code for mask, code in _SAFETY_CODES if bits & mask), "")


_FLOOR_S, _FLOOR_FAST_S = 0.5, 3.0


class StateFeed:
    """Snapshots as they come in; `lost` says whether the link is, and `alive` raises the fault of that."""

    def __init__(
        self, name: str, clock: Clock, lost: Callable[[], bool], alive: Callable[[], None], statistics: LinkStatistics
    ) -> None:
        self._name = name
        self._clock = clock
        self._lost = lost
        self._alive = alive
        self._statistics = statistics
        self._news = threading.Condition()
        self._snapshot: Snapshot | None = None
        self._listeners: list[Callable[[Snapshot], None]] = []

    def take(self, snapshot: Snapshot) -> None:
        """A new snapshot has come."""
        with self._news:
            self._snapshot = snapshot
            for listener in self._listeners:
                listener(snapshot)
            self._news.notify_all()

    @contextmanager
    def listening(self, listener: Callable[[Snapshot], None]) -> Iterator[None]:
        """`listener` is told every snapshot that comes while the context is open, in order, by the link's thread."""
        with self._news:
            self._listeners = [*self._listeners, listener]
        try:
            yield
        finally:
            with self._news:
                self._listeners = [kept for kept in self._listeners if kept is not listener]

    def forget(self) -> None:
        """What was seen before a new link says nothing any more."""
        with self._news:
            self._snapshot = None

    def wake(self) -> None:
        """Let everybody who waits look whether the link is lost."""
        with self._news:
            self._news.notify_all()

    def fresh(self, max_age: float) -> tuple[Snapshot, float]:
        """The newest snapshot, at most `max_age` s old or received after the call, and its age in s of the clock.
        Raises `DeadlineError` when there is none in time."""
        self._alive()
        called = time.monotonic()

        def usable(snapshot: Snapshot) -> bool:
            return snapshot.stamp >= called or self.age(snapshot) <= max_age

        # Only simulated arms are driven faster than the wall, and they share a busy machine with everything else.
        floor = _FLOOR_S if self._clock.rate <= 1.0 else _FLOOR_FAST_S
        if not self.wait_for(usable, max(floor, self._clock.wall(max_age))):
            self._statistics.count("state too old")
            raise DeadlineError(self._name, f"no state of the arm that is at most {shown(max_age, 's')} old")
        snapshot = self._snapshot
        assert snapshot is not None
        return snapshot, self.age(snapshot)

    def wait_for(self, holds: Callable[[Snapshot], bool], wall_seconds: float) -> bool:
        """Wait until the newest snapshot satisfies `holds`; raises the fault when the link is lost meanwhile."""
        with self._news:
            met = self._news.wait_for(
                lambda: self._lost() or (self._snapshot is not None and holds(self._snapshot)), wall_seconds
            )
        self._alive()
        return met

    def age(self, snapshot: Snapshot) -> float:
        """How old a snapshot is, in s of the clock."""
        return (time.monotonic() - snapshot.stamp) * self._clock.rate
