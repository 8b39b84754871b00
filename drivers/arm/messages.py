"""What the arm driver and its child process say to each other over their pipe, pickled.

The driver sends one `ChildSetup`, then `ChildRequest`s; the child answers each with a `ChildReply` and sends
`Snapshot`s, `Ended` and `Lost` by itself. Positions in m and rad, forces in N, times in s of the system's monotonic
clock, which all processes share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
    is the owner's sign of life (`drivers.pulse`). `attend` with wall seconds: from now on what moves is stopped unless
    this is said again within them; 0 ends that.
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
    """The motion is over: `how` is arrived, contact, stopped, or the code of a fault with its `text`.

    `pace` is that of a trajectory's points.
    """

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
