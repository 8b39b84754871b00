"""What each kind of device promises, whatever its make.

Units are SI, times are seconds of the injected `Clock`. Every method raises a `drivers.errors.CellError`: limits are
checked before anything is sent (`LimitError`), a peer that is silent is a `DeadlineError` or `NotConnectedError`, a
fault of the device is a `DeviceFault` that names it. Nothing returns a stale reading as if it were fresh.

Commands that move return at once with a `Motion`; `wait()` on it blocks. `stop()` may be called from any thread at any
time, overtakes every queued or running command, returns when the device has taken it, and is idempotent. `close()`
leaves the device safe and is idempotent.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Protocol, TypeAlias, runtime_checkable

from drivers.clock import Latch

if TYPE_CHECKING:
    # The arm's process, which starts with each connection, does without.
    import numpy as np
    from numpy.typing import NDArray

Vector: TypeAlias = "NDArray[np.float64]"
"""Array of shape (n,), float64."""

ATTENDED_S = 0.15
"""Wall seconds of silence after which a motion that somebody attends is stopped: nearly two beats of 80 ms. With what
braking a slow motion takes the device stands within 250 ms."""


@dataclass(frozen=True)
class Identity:
    """Who a device is: used by `cell diag` and to tie a calibration to its hardware."""

    model: str
    serial: str
    firmware: str
    address: str


Listener = Callable[[bool, object], None]
"""Given whether it was sent, and what: bytes of a serial line, a `can.Message`, a line of text, or a record of values
where a maker's library keeps the bytes to itself."""


class Traffic:
    """The traffic of one device; `listener` is told all of it."""

    def __init__(self) -> None:
        self.listener: Listener | None = None

    def sent(self, what: object) -> None:
        """The link sends this."""
        if (listener := self.listener) is not None:
            listener(True, what)

    def received(self, what: object) -> None:
        """The link has received this."""
        if (listener := self.listener) is not None:
            listener(False, what)


@dataclass
class LinkStatistics:
    """Health of a link since it was opened: round trips in seconds (newest 1000) and error counters by name; and its
    `traffic`, for whoever listens."""

    round_trips_s: list[float] = field(default_factory=list)
    errors: dict[str, int] = field(default_factory=dict)
    traffic: Traffic = field(default_factory=Traffic, repr=False, compare=False)

    def add_round_trip(self, seconds: float) -> None:
        """Record one round trip, forgetting the oldest beyond 1000."""
        self.round_trips_s.append(seconds)
        if len(self.round_trips_s) > 1000:
            del self.round_trips_s[:500]

    def count(self, name: str) -> None:
        """Add one to the error counter `name`."""
        self.errors[name] = self.errors.get(name, 0) + 1


@dataclass(frozen=True)
class Reading:
    """One figure of a device's health: `value` in `unit`, good from `least` to `most`; None where there is no limit.

    `remedy` is what a person does when it is outside. A value that is not a number is outside of any limit.
    """

    what: str
    value: float
    unit: str
    least: float | None = None
    most: float | None = None
    remedy: str = ""

    @property
    def ok(self) -> bool:
        """Whether the value is inside its limits."""
        above = self.least is None or self.value >= self.least
        return above and (self.most is None or self.value <= self.most)


@runtime_checkable
class Examined(Protocol):
    """What a device may offer besides `Device`: figures of its health."""

    def examine(self, seconds: float) -> list[Reading]:
        """Watch the device for `seconds` of the clock: nothing on it is set, started or ended. Errors as of `ping`."""


class Device(Protocol):
    """What every device offers. `name` is its name in the configuration and in every error."""

    name: str
    statistics: LinkStatistics

    def identity(self) -> Identity:
        """Ask the device who it is."""

    def ping(self) -> float:
        """One harmless round trip on the wire, in wall seconds; also recorded in `statistics`."""

    def stop(self) -> None:
        """Bring the device to rest (or its output off) now, overtaking everything."""

    def close(self) -> None:
        """Stop, then release the connection."""


class Motion(Protocol):
    """A motion that was started."""

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""

    def wait(self, timeout: float) -> None:
        """Block until the motion has reached its end.

        Raises `DeadlineError` after `timeout` seconds (the device is then stopped), `DeviceFault` when the device
        failed, `Aborted` when `stop()` ended the motion early. Never returns for a motion that did not arrive.
        """


@runtime_checkable
class Attended(Protocol):
    """What a device may offer besides: motions that go on only as long as somebody says so again and again."""

    def attended(self) -> AbstractContextManager[Callable[[], None]]:
        """While it is open, what moves is stopped once the function that it gives was not called for `ATTENDED_S`.

        A process beside this one sees to that, also when this one hangs, is frozen or was killed. `InterlockError` when
        there is none; the function raises it, or a `DeviceFault`, when it is lost.
        """


class Laser(Device, Protocol):
    """A line laser on a switch with an interlock: lit only while its owner holds it."""

    def lit(self) -> AbstractContextManager[None]:
        """On inside the context, off after it, whatever happens inside."""

    @property
    def is_on(self) -> bool:
        """What the output shows, not what was commanded."""


@runtime_checkable
class SaysHowKnown(Protocol):
    """What a laser may offer besides `Laser` when nobody can ask its switch."""

    @property
    def how_known(self) -> str:
        """Why `is_on` is not what the output shows, in words for people; "" where it is."""


class Claw(Device, Protocol):
    """A gripper on a switch with a feedback input."""

    def grip(self, timeout: float = 2.0) -> None:
        """Close; `DeviceFault` when the feedback does not confirm a held part in time."""

    def release(self, timeout: float = 2.0) -> None:
        """Open; `DeviceFault` when the feedback still shows a held part."""

    @property
    def holding(self) -> bool:
        """What the feedback shows."""


class ArmSafety(Enum):
    """What the arm's safety system allows."""

    NORMAL = "normal"
    PROTECTIVE_STOP = "protective stop"
    SAFEGUARD_STOP = "safeguard stop"
    EMERGENCY_STOP = "emergency stop"
    FAULT = "fault"


@dataclass(frozen=True, eq=False)
class ArmState:
    """One state packet.

    `flange` is base_from_flange as (x, y, z, rx, ry, rz), m and rotation vector in rad, as the arm reports it from its
    joint encoders; `wrench` is force and torque at the flange in base axes, N and N·m. `stamp` is the host time at
    which the packet arrived, `device_time` in s the arm's own clock when it was measured. `controlled` is False while
    nothing can move the arm, because it has no power or no control program; its flange may then be that of any tool.
    `reason` says in words why it stopped for safety, as far as that is known.
    """

    stamp: float
    joints: Vector
    joint_speeds: Vector
    flange: Vector
    wrench: Vector
    safety: ArmSafety
    moving: bool
    digital_inputs: int
    digital_outputs: int
    device_time: float = 0.0
    controlled: bool = True
    reason: str = ""


class ArmMotion(Motion, Protocol):
    """A motion of the arm; `contact` tells whether a guarded motion ended because the force limit was met."""

    @property
    def contact(self) -> bool:
        """Whether it ended at its force limit."""


class Arm(Device, Protocol):
    """A six-axis arm with zero TCP: all Cartesian poses are of the flange in the base."""

    def link_table(self) -> LinkTable | None:
        """The table that its controller computes with, calibrated in the factory; None where it does not tell."""

    def state(self, max_age: float = 0.1) -> ArmState:
        """The newest state, at most `max_age` seconds old, else `DeadlineError`."""

    def record(self) -> AbstractContextManager[list[ArmState]]:
        """Every state that arrives while the context is open, in order, in a list that grows."""

    def latch_clock(self) -> Latch:
        """The arm's clock, as `device_time` of its states tells it, between two host times; takes a tenth of a second.

        That a state was measured when its time says so has to be taken on trust: how long the arm itself held it back
        before it was stamped cannot be known from outside.
        """

    def move_joints(self, joints: Vector, speed: float, acceleration: float) -> ArmMotion:
        """Straight in joint space to `joints` (rad) at `speed` rad/s of the leading joint."""

    def move_linear(self, flange: Vector, speed: float, acceleration: float) -> ArmMotion:
        """Straight in space to the flange pose (x, y, z, rx, ry, rz) at `speed` m/s."""

    def follow(self, times: Vector, joints: Vector, force_limit: float | None = None) -> ArmMotion:
        """Stream a joint trajectory: `times` (n,) s from 0, `joints` (n, 6) rad, on absolute deadlines.

        The first point must be where the arm stands (0.02 rad), else `InterlockError`. With `force_limit` (N) the
        motion ends, held at rest and without error, as soon as the force has changed by that much since its start.
        """

    def zero_force(self) -> None:
        """Take the present wrench as zero."""

    def set_payload(self, mass: float, centre: Vector) -> None:
        """Mass in kg and centre of gravity (3,) in the flange frame, m."""

    def set_digital_output(self, index: int, value: bool) -> None:
        """Set a digital output (0-7 standard, 8-15 configurable, 16-17 tool) and return once the arm shows it."""

    def digital_input(self, index: int) -> bool:
        """Read a digital input from the newest state."""

    def recover(self, *, confirmed: bool = False) -> None:
        """Restart the link if needed and upload the control program again, with the laser's output off.

        A protective stop is cleared only when a person has `confirmed` it, else `DeviceFault` (arm.protective_stop).
        `stop()` and `close()` end it: it raises `Aborted`, and nothing was unlocked or started after them.
        """


@runtime_checkable
class TriesOutputs(Protocol):
    """What an arm may offer besides `Arm` when the laser hangs on its outputs and may hang on another than is told."""

    def trying(self, index: int) -> AbstractContextManager[None]:
        """Inside the context this output goes off as the laser's does when link, driver or this process are lost."""


@runtime_checkable
class SaysWhyUntold(Protocol):
    """What an arm may offer besides `Arm`: a reason beside a link table that it did not tell."""

    @property
    def untold(self) -> str:
        """Why `Arm.link_table` is None, in words; "" where it is not, or where the arm never tells one."""


def why_untold(arm: Arm) -> str:
    """Why the arm has told no link table, or "" when it has, or gives no reason."""
    return arm.untold if isinstance(arm, SaysWhyUntold) else ""


@dataclass(frozen=True)
class RailState:
    """Rail reading; `stamp` is the host time (middle of the round trip) at which `position` held.

    `homed` is what the device says, whoever homed it and whenever; `homed_here` that this program did, so that nothing
    can have moved it unseen.
    """

    stamp: float
    position: float
    velocity: float
    homed: bool
    moving: bool
    left_switch: bool
    right_switch: bool
    homed_here: bool = False


class Sweep(Motion, Protocol):
    """A constant-velocity sweep that is being recorded."""

    @property
    def samples(self) -> Vector:
        """Recorded (n, 2) array of host time in s and position in m, so far."""

    @property
    def window(self) -> tuple[float, float]:
        """Host times between which the velocity is constant; known once the sweep has ended."""

    def position_at(self, host_time: float) -> float:
        """Position in m at a host time inside `window`; `ValueError` outside."""

    @property
    def time_bound(self) -> float:
        """Largest error in s of the times behind `position_at`, known once the sweep has ended.

        A reading's time is known within its round trip only. Replies that are all late by as much shift all positions
        by what the rail covers in half of that: nothing in the readings shows it.
        """

    @property
    def unevenness(self) -> float:
        """Median distance in m of the readings from an even motion, beyond what their round trips explain."""


LONGEST_NUDGE_M = 0.010
"""How far a rail is moved at most whose zero nobody knows."""


@runtime_checkable
class Nudged(Protocol):
    """What a rail may offer besides `Rail`: a small motion before its zero is known."""

    def nudge(self, distance: float, speed: float) -> Motion:
        """Move by `distance` m, at most `LONGEST_NUDGE_M` either way, at `speed` m/s, homed or not.

        No travel bounds it, only the limit switches: it is for finding out which way and how far the rail really goes.
        """


@runtime_checkable
class ChecksZero(Protocol):
    """What a rail may offer besides `Rail`: to look whether it has lost steps since it was homed."""

    def check_zero(self) -> Motion | None:
        """Creep over the reference switch and end at 0; None where the switch cannot be asked.

        The motion fails with `DeviceFault` (rail.lost_steps) when the count is off there: then it is not homed any
        more.
        """


class Rail(Device, Protocol):
    """A linear axis that carries the scan head; positions in m from the home switch."""

    travel: tuple[float, float]

    def state(self) -> RailState:
        """Read position, velocity, switches and whether it is homed now.

        Raises `DeviceFault` (rail.reset), once, when the device has lost the zero that it had.
        """

    def home(self) -> Motion:
        """Search the reference switch; position 0 is there afterwards."""

    def move_to(self, position: float, speed: float | None = None) -> Motion:
        """Move to `position`; refused with `InterlockError` before homing, `DeviceFault` when the zero was lost."""

    def sweep(self, start: float, stop: float, speed: float) -> Sweep:
        """Move so that the velocity is constant from `start` to `stop`, with start-up and run-out outside of them.

        The rail has to stand at `sweep_start(start, stop, speed)` already. Position is sampled all the way.
        """

    def sweep_start(self, start: float, stop: float, speed: float) -> float:
        """Where the rail has to stand before `sweep`: `start` less the start-up distance; `LimitError` if outside."""


Image: TypeAlias = "NDArray[np.uint8]"
"""Grey image of shape (height, width), 8 bit, row 0 at the top."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture. Times are the start of the exposure on the device's and on the host's clock, in s."""

    image: Image
    frame_id: int
    exposure: float
    device_time: float
    host_time: float
    received: float
    lost_before: int = 0

    @property
    def mid_exposure(self) -> float:
        """Host time of the middle of the exposure."""
        return self.host_time + 0.5 * self.exposure


class FrameStream(Protocol):
    """Frames as they come; knows how many were lost between them (from the gaps in the frame ids)."""

    lost: int

    def next(self, timeout: float) -> Frame:
        """The next frame in order; `DeadlineError` when none comes in time, `DeviceFault` when the camera is lost."""

    def __iter__(self) -> Iterator[Frame]:
        """Frames until the stream is closed."""


class Camera(Device, Protocol):
    """A camera that delivers 8-bit grey frames."""

    shape: tuple[int, int]

    @property
    def time_bound(self) -> float:
        """Largest error in s of the host times of its newest frames, as far as the clocks could be compared."""

    def configure(self, exposure: float, frame_rate: float) -> None:
        """Set exposure in s and frame rate in Hz; refused outside the range or when they clash."""

    def grab(self, timeout: float = 2.0) -> Frame:
        """One frame whose exposure began after the call: never a buffered one."""

    def stream(self) -> AbstractContextManager[FrameStream]:
        """Free-running acquisition for as long as the context is open."""


@dataclass(frozen=True)
class VehicleState:
    """Vehicle feedback.

    Odometry is integrated by the driver from the wheel distances since it was opened: x, y in m and yaw in rad in the
    frame where the vehicle stood then; `speed` m/s and `yaw_rate` rad/s as reported. `braked` is None until this
    driver has commanded the brake while it is in command, and when that may not hold any more; `battery_volts` where
    nobody tells it. `trouble` says in words what ends motion, `warnings` what does not. `interruptions` counts how
    often odometry lost its connection to where the vehicle was before, and `interruption` says why it did last.
    """

    stamp: float
    x: float
    y: float
    yaw: float
    speed: float
    yaw_rate: float
    command_mode: bool
    braked: bool | None
    emergency_stop: bool
    error_bits: int
    battery_volts: float | None
    trouble: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    interruptions: int = 0
    interruption: str = ""


class Vehicle(Device, Protocol):
    """A carrier that turns by the speeds of its two sides."""

    def state(self, max_age: float = 0.2) -> VehicleState:
        """The newest feedback, at most `max_age` seconds old, else `DeadlineError`."""

    def check(self) -> None:
        """Raise the `DeviceFault` that the vehicle shows: lost link, silence, emergency stop, error, lost command."""

    def enable(self) -> None:
        """Take command over CAN and release the brake."""

    def recover(self) -> None:
        """Clear what can be cleared and take command again, with the brake locked throughout."""

    def drive(self, speed: float, yaw_rate: float) -> None:
        """Set the velocity that is kept alive until the next call or `stop()`; must be renewed within 0.5 s."""

    def brake(self) -> None:
        """Stop, wait for standstill and lock the brake."""


_MOST = {"theta": 100.0, "a": 10.0, "d": 10_000.0, "alpha": 2.0 * math.pi}
"""Larger numbers are garbage. In factory tables d of axes that are almost parallel reaches hundreds of metres."""


@dataclass(frozen=True)
class LinkTable:
    """One number a joint, each tuple (6,): theta and alpha in rad, a and d in m (docs/reference/protocols.md, section
    1).

    A link turns about z by the joint's angle plus theta, moves along z by d, along the new x by a, and turns about it
    by alpha. In a factory table d of joints 2 to 4 may be hundreds of metres and cancel: their axes are almost
    parallel, and where their common normals lie is nearly arbitrary.
    """

    theta: tuple[float, ...]
    a: tuple[float, ...]
    d: tuple[float, ...]
    alpha: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, most in _MOST.items():
            values = getattr(self, name)
            if len(values) != 6 or not all(abs(value) <= most for value in values):
                unit = "m" if name in ("a", "d") else "rad"
                raise ValueError(f"{name} of a link table is {values}; six numbers within ±{most:g} {unit} are needed")

    def hash(self) -> str:
        """Twelve hexadecimal digits that tell this table from every other one, to the last bit."""
        numbers = struct.pack(">24d", *self.theta, *self.a, *self.d, *self.alpha)
        return hashlib.sha256(numbers).hexdigest()[:12]
