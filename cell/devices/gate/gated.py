"""The devices behind the gate: each holds a device of any make and lets begin only what the gate lets begin.

Reading, stopping and closing always pass. What a method does stands in `drivers.interfaces`; what a make offers beyond
them is asked of the bare device (`bare`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from cell.devices.gate.gate import Gate, Gated
from cell.devices.gate.interlocks import DeviceCommand
from drivers import interfaces
from drivers.clock import Clock, Latch
from drivers.errors import CellError, DeadlineError, InterlockError, LimitError, check_range

if TYPE_CHECKING:
    from cell.devices.simulated.mixed import SimulatedTouch


log = logging.getLogger(__name__)

TURN_RAD = 2 * math.pi
"""No joint turns further than a full turn from zero."""
FAR_M = 3.0
"""No arm of this kind reaches further from its base."""


def checked_joints(device: str, joints: ArrayLike) -> interfaces.Vector:
    """Joint angles (6,) in rad, else `LimitError`."""
    array = _numbers(device, "joint angles", joints)
    if array.shape != (6,):
        raise LimitError(device, f"joint angles must be 6 numbers, got shape {array.shape}; nothing was sent")
    return _turns(device, array)


def checked_way(device: str, joints: ArrayLike) -> interfaces.Vector:
    """Joint angles (n, 6) in rad of at least one point, else `LimitError`."""
    array = _numbers(device, "a trajectory's joint angles", joints)
    if array.ndim != 2 or array.shape[1] != 6 or not len(array):
        raise LimitError(
            device, f"a trajectory needs joint angles (n, 6), n at least 1, got shape {array.shape}; nothing was sent"
        )
    return _turns(device, array)


def checked_pose(device: str, flange: ArrayLike) -> interfaces.Vector:
    """The flange's pose (6,) in the base, m and rotation vector in rad, else `LimitError`."""
    array = _numbers(device, "flange pose", flange)
    if array.shape != (6,):
        raise LimitError(device, f"flange pose must be 6 numbers, got shape {array.shape}; nothing was sent")
    check_range(device, "distance of the flange from the base", float(np.linalg.norm(array[:3])), 0.0, FAR_M, unit="m")
    return array


def _numbers(device: str, what: str, values: ArrayLike) -> interfaces.Vector:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise LimitError(device, f"{what} must be numbers; nothing was sent: {error}") from error
    if not np.isfinite(array).all():
        raise LimitError(device, f"{what} hold values that are not finite; nothing was sent")
    return array


def _turns(device: str, joints: interfaces.Vector) -> interfaces.Vector:
    for value in (joints.min(), joints.max()):
        check_range(device, "joint angle", float(value), low=-TURN_RAD, high=TURN_RAD, unit="rad")
    return joints


class GuardedMotion:
    """`motion` of `arm`; see `drivers.interfaces.ArmMotion`."""

    def __init__(self, motion: interfaces.ArmMotion, arm: interfaces.Arm) -> None:
        self.rest: interfaces.Vector | None = None
        """Joint angles (6,) in rad after it had ended at contact, when that was first seen."""
        self._motion = motion
        self._arm = arm

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        return self._motion.done

    @property
    def contact(self) -> bool:
        """Whether it ended at its force limit."""
        return self._motion.contact

    def wait(self, timeout: float) -> None:
        self._motion.wait(timeout)
        if self.contact and self.rest is None:
            self.rest = self._arm.state().joints


Begun = TypeVar("Begun", bound=interfaces.Motion)

TIMEOUT_S = 1.0
"""How old the arm's state may be that a speed rests on: the arm stands."""


class GatedArm(Gated[interfaces.Arm]):
    """The arm, its motions and its recovery begun through a gate. `touch` adds what it would feel of a simulated
    station; None where the station is as real as the arm."""

    touch: SimulatedTouch | None = None

    def link_table(self) -> interfaces.LinkTable | None:
        return self.bare.link_table()

    @property
    def untold(self) -> str:
        return interfaces.why_untold(self.bare)

    def state(self, max_age: float = 0.1) -> interfaces.ArmState:
        state = self.bare.state(max_age)
        if self.touch is not None:
            state = self.touch.felt(state)
        self.gate.seen("arm", state)
        return state

    @contextmanager
    def record(self) -> Iterator[list[interfaces.ArmState]]:
        with self.bare.record() as states:
            yield states
        if self.touch is not None:
            self.touch.recorded(states)
        for state in states:
            self.gate.seen("arm", state)

    def latch_clock(self) -> Latch:
        return self.bare.latch_clock()

    def move_joints(self, joints: interfaces.Vector, speed: float, acceleration: float) -> interfaces.ArmMotion:
        """See `Arm.move_joints`; slower where the tool, or the part in it, would exceed the arm's tool speed."""
        goal = checked_joints(self.name, joints)
        situation = self.gate.interlocks.situation

        def start() -> interfaces.ArmMotion:
            slowed = situation.slowed(self.bare.state(TIMEOUT_S).joints, goal, speed, situation.held)
            return self.bare.move_joints(joints, slowed, acceleration)

        return self._move(DeviceCommand("arm", "move_joints", {"joints": goal}), start)

    def move_linear(self, flange: interfaces.Vector, speed: float, acceleration: float) -> interfaces.ArmMotion:
        command = DeviceCommand("arm", "move_linear", {"flange": checked_pose(self.name, flange)})
        return self._move(command, lambda: self.bare.move_linear(flange, speed, acceleration))

    def follow(
        self, times: interfaces.Vector, joints: interfaces.Vector, force_limit: float | None = None
    ) -> interfaces.ArmMotion:
        way = checked_way(self.name, joints)
        command = DeviceCommand("arm", "follow", {"joints": way, "force_limit": force_limit})
        if force_limit is None:
            return self._move(command, lambda: self.bare.follow(times, joints))

        def start() -> interfaces.ArmMotion:
            motion = self.bare.follow(times, joints, force_limit)
            if self.touch is not None:
                motion = self.touch.guard(motion, force_limit, self.bare.stop)
            return GuardedMotion(motion, self.bare)

        return self._move(command, start)

    def _move(self, command: DeviceCommand, start: Callable[[], interfaces.ArmMotion]) -> interfaces.ArmMotion:
        situation = self.gate.interlocks.situation

        def begin() -> interfaces.ArmMotion:
            # Should the start fail, the arm may move all the same: what its motion before ended with holds no more.
            situation.last = None
            situation.way = command.arguments.get("joints") if command.name == "follow" else None
            situation.last = motion = start()
            return motion

        return self.gate.begin(command, begin, self.bare.stop)

    def zero_force(self) -> None:
        self.gate.require(DeviceCommand("arm", "zero_force"))
        self.bare.zero_force()
        if self.touch is not None:
            self.touch.zero()

    def set_payload(self, mass: float, centre: interfaces.Vector) -> None:
        self.gate.require(DeviceCommand("arm", "set_payload"))
        self.bare.set_payload(mass, centre)

    def set_digital_output(self, index: int, value: bool) -> None:
        """See `Arm.set_digital_output`. A laser, or what may be one, is switched off also after, and by, a stop."""
        command = DeviceCommand("arm", "set_digital_output", {"index": index, "value": value})
        laser = self.gate.interlocks.may_be_laser(index)

        def off() -> None:
            if laser:
                self.bare.set_digital_output(index, False)

        if value or not laser:
            self.gate.begin(command, lambda: self.bare.set_digital_output(index, value), off)
        else:
            off()

    def digital_input(self, index: int) -> bool:
        return self.bare.digital_input(index)

    def recover(self, *, confirmed: bool = False) -> None:
        def begin() -> None:
            self.gate.interlocks.situation.last = None
            self.bare.recover(confirmed=confirmed)

        self.gate.begin(DeviceCommand("arm", "recover"), begin, self.bare.stop)


class GatedRail(Gated[interfaces.Rail]):
    """The rail, its motions begun through a gate."""

    def __init__(self, bare: interfaces.Rail, gate: Gate) -> None:
        super().__init__(bare, gate)
        self.travel = bare.travel
        self.motion: interfaces.Motion | None = None
        """The newest motion that was begun, also one that has ended."""

    def state(self) -> interfaces.RailState:
        state = self.bare.state()
        self.gate.seen("rail", state)
        return state

    def home(self) -> interfaces.Motion:
        return self._begin(DeviceCommand("rail", "home"), self.bare.home)

    def move_to(self, position: float, speed: float | None = None) -> interfaces.Motion:
        command = DeviceCommand("rail", "move_to", {"position": position})
        return self._begin(command, lambda: self.bare.move_to(position, speed))

    def nudge(self, distance: float, speed: float) -> interfaces.Motion:
        """See `Nudged.nudge`; `InterlockError` for a rail that does not offer it."""
        bare = self.bare
        if not isinstance(bare, interfaces.Nudged):
            raise InterlockError(self.name, "this make of rail moves only when it is homed; home it first")
        command = DeviceCommand("rail", "nudge", {"distance": distance})
        return self.gate.begin(command, lambda: bare.nudge(distance, speed), self.bare.stop)

    def check_zero(self) -> interfaces.Motion | None:
        """See `ChecksZero`; None also for a make that does not offer it."""
        bare = self.bare
        if not isinstance(bare, interfaces.ChecksZero):
            return None
        motion = self.gate.begin(DeviceCommand("rail", "move_to", {"position": 0.0}), bare.check_zero, bare.stop)
        self.motion = motion or self.motion
        return motion

    def sweep(self, start: float, stop: float, speed: float) -> interfaces.Sweep:
        command = DeviceCommand("rail", "sweep", {"start": start, "stop": stop})
        return self._begin(command, lambda: self.bare.sweep(start, stop, speed))

    def sweep_start(self, start: float, stop: float, speed: float) -> float:
        return self.bare.sweep_start(start, stop, speed)

    def _begin(self, command: DeviceCommand, start: Callable[[], Begun]) -> Begun:
        motion = self.gate.begin(command, start, self.bare.stop)
        self.motion = motion
        return motion


class GatedVehicle(Gated[interfaces.Vehicle]):
    """The vehicle, taken into command and driven through a gate."""

    def state(self, max_age: float = 0.2) -> interfaces.VehicleState:
        state = self.bare.state(max_age)
        self.gate.seen("vehicle", state)
        return state

    def check(self) -> None:
        self.bare.check()

    def enable(self) -> None:
        def begin() -> None:
            # Only now may it drive away: one that could not be enabled still stands where it stood.
            self.bare.enable()
            self.gate.interlocks.stand_before(())

        self.gate.begin(DeviceCommand("vehicle", "enable"), begin, self.bare.brake)

    def recover(self) -> None:
        self.gate.begin(DeviceCommand("vehicle", "recover"), self.bare.recover, self.bare.brake)

    def drive(self, speed: float, yaw_rate: float) -> None:
        """See `Vehicle.drive`. One that is refused also ends the velocity that was set before."""
        command = DeviceCommand("vehicle", "drive", {"speed": speed, "yaw_rate": yaw_rate})
        try:
            self.gate.begin(command, lambda: self.bare.drive(speed, yaw_rate), self.bare.stop)
        except CellError:
            with suppress(CellError):
                self.bare.drive(0.0, 0.0)
            raise

    def brake(self) -> None:
        self.gate.asked(DeviceCommand("vehicle", "brake"))
        self.bare.brake()


class GatedClaw(Gated[interfaces.Claw]):
    """The claw, closed and opened through a gate; what it did is not undone, because that could drop the part."""

    def grip(self, timeout: float = 2.0) -> None:
        self.gate.begin(DeviceCommand("claw", "grip"), lambda: self.bare.grip(timeout), lambda: None)

    def release(self, timeout: float = 2.0) -> None:
        def start() -> None:
            self.bare.release(timeout)
            self.gate.interlocks.carry(())

        self.gate.begin(DeviceCommand("claw", "release"), start, lambda: None)

    @property
    def holding(self) -> bool:
        holding = self.bare.holding
        self.gate.seen("claw", {"holding": holding})
        return holding


TRIES = 3
"""How often at most a picture of a world that follows real devices is asked for, each time with the whole time that it
may take."""


class GatedCamera(Gated[interfaces.Camera]):
    """A camera whose commands are told at the gate. `tries`: how often at most a picture is asked for.
    `longest_exposure`: what ambient light allows, s; a longer one that is asked for is shortened to it."""

    tries = 1
    longest_exposure = math.inf

    def __init__(self, bare: interfaces.Camera, gate: Gate) -> None:
        super().__init__(bare, gate)
        self.shape = bare.shape
        self._asked = math.inf, 1.0

    @property
    def time_bound(self) -> float:
        return self.bare.time_bound

    def configure(self, exposure: float, frame_rate: float) -> None:
        self._asked, exposure = (exposure, frame_rate), min(exposure, self.longest_exposure)
        self.gate.asked(DeviceCommand(self.name, "configure", {"exposure": exposure, "frame_rate": frame_rate}))
        self.bare.configure(exposure, frame_rate)

    def shorten(self, longest: float) -> None:
        """Expose no longer than `longest`, s, from now on; raises what `configure` raises."""
        self.longest_exposure = longest
        self.configure(*self._asked)

    def grab(self, timeout: float = 2.0) -> interfaces.Frame:
        """See `Camera.grab`; with more `tries` than one the last one's `DeadlineError`."""
        self.gate.asked(DeviceCommand(self.name, "grab"))
        for k in range(1, self.tries):
            try:
                return self.bare.grab(timeout)
            except DeadlineError as error:
                self.statistics.count("picture asked for again")
                log.info("%s; asked for again, %d of %d", error, k + 1, self.tries)
        return self.bare.grab(timeout)

    @contextmanager
    def stream(self) -> Iterator[interfaces.FrameStream]:
        self.gate.asked(DeviceCommand(self.name, "stream"))
        try:
            with self.bare.stream() as frames:
                yield frames
        finally:
            self.gate.asked(DeviceCommand(self.name, "stream ended"))


UNATTENDED_S = 20.0
"""Seconds on the wall for which the laser stays on when nobody renews it: eyes do not run faster with a simulation."""
RETRY_S = 0.5
"""Seconds on the wall after which a laser that could not be switched off is switched off again."""


class GatedLaser(Gated[interfaces.Laser]):
    """The laser, lit through a gate and for as long as its owner renews it."""

    def __init__(self, bare: interfaces.Laser, gate: Gate, clock: Clock) -> None:
        super().__init__(bare, gate)
        self._clock = clock
        self._renewed = 0.0
        self._slept = self._off = False

    @contextmanager
    def lit(self) -> Iterator[None]:
        """See `Laser.lit`. Goes off, and raises `InterlockError` at the end, when it is not renewed every 20 s."""
        with ExitStack() as held:
            held.callback(lambda: self.gate.asked(DeviceCommand("laser", "off")))
            self.gate.begin(DeviceCommand("laser", "lit"), lambda: held.enter_context(self.bare.lit()), held.close)
            self._renewed, self._slept, self._off = self._clock.now(), False, False
            with self._clock.alarm(self._limit, self._check):
                yield
                self.renew()

    def renew(self) -> None:
        """Its owner is awake. `InterlockError` when it had fallen asleep and the laser went off meanwhile."""
        if self._slept:
            became = "went off" if self._off else "was to go off, which is not confirmed,"
            raise InterlockError(
                self.name,
                f"{became} because nobody renewed it for {UNATTENDED_S:.0f} s (interlock laser_attended). Light it "
                "only while it is needed, and call renew() on it meanwhile",
            )
        self._renewed = self._clock.now()

    @property
    def is_on(self) -> bool:
        on = self.bare.is_on
        self.gate.seen("laser", {"on": on})
        return on

    @property
    def _limit(self) -> float:
        return UNATTENDED_S * self._clock.rate

    def _check(self) -> float | None:
        """Called by the alarm: off when the owner sleeps, else in how many seconds to look again. One that cannot be
        switched off is switched off again and again, until its owner's context ends."""
        left = self._renewed + self._limit - self._clock.now()
        if left > 0:
            return left
        self._slept = True
        try:
            self.bare.stop()
        # Whatever went wrong, the next attempt may do it.
        except Exception as error:
            log.error("the laser's owner sleeps, and it could not be switched off: %s", error)
            return RETRY_S * self._clock.rate
        self._off = True
        return None
