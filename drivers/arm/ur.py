"""The arm driver: a Universal Robots e-series arm with zero TCP, behind ur-rtde in a supervised child process.

Everything is checked here before anything is sent; the child does the talking. A lost child or link is a
`DeviceFault` in every waiting call, after which the arm is stopped and the safe outputs are switched off by other
ways; `recover()` starts afresh. A cut cable is noticed by the controller's own watchdog, which ends the program.
"""

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np

from drivers.arm import health
from drivers.arm.dashboard import unknown
from drivers.arm.factory import Forward, read_factory_kinematics
from drivers.arm.faults import late_words
from drivers.arm.feed import MODE_RUNNING, ChildSetup, Ended, Snapshot, safety_code
from drivers.arm.limits import ArmLimits
from drivers.arm.link import latch_clock
from drivers.arm.motion import UrMotion
from drivers.arm.session import ArmSession
from drivers.clock import Clock, Latch
from drivers.errors import UNTOLD, Aborted, DeviceError, InterlockError, LimitError, check_positive, shown
from drivers.interfaces import ATTENDED_S, ArmSafety, ArmState, Identity, LinkTable, Reading, Vector

_FIRST_POINT = 0.02
_WATCHDOG_S, _WATCHDOG_FAST_S = 0.15, 0.45
"""Silence in seconds on the wall after which the controller ends its program.

Only simulated arms are driven faster than the wall, and they share a busy machine with everything else.
"""
_TOLD_S = 2.0
"""What the controller has for telling its table, wall seconds; it does so ten times a second if the port is open."""
_OUTPUTS = 18
_SAFETY = {
    "": ArmSafety.NORMAL,
    "arm.protective_stop": ArmSafety.PROTECTIVE_STOP,
    "arm.safeguard_stop": ArmSafety.SAFEGUARD_STOP,
    "arm.emergency_stop": ArmSafety.EMERGENCY_STOP,
    "arm.recovery_mode": ArmSafety.FAULT,
    "arm.safety_fault": ArmSafety.FAULT,
}


class UrArm:
    """A UR arm at `address`; see `drivers.interfaces.Arm` for the promises.

    `payload` is mass in kg and centre of gravity (3,) in the flange frame in m. `safe_off_outputs` are switched off
    when the driver closes or dies, or its link is lost: the laser's output belongs here. `braking` is the deceleration
    of a stop in rad/s². `connect_timeout` is in wall seconds. Raises `NotConnectedError` when no arm answers.

    `forward`, joints (6,) in rad to the flange's pose (6,), is the caller's own model of the arm, or `forward_of` makes
    it from the table that the controller tells, None where it tells none. Here and before every motion it has to agree
    with what the arm reports within 0.05 mm and 0.1 mrad, else `DeviceFault` (arm.wrong_kinematics).

    `model`, where it is given, is what the dashboard has to call the arm, else `DeviceFault` (arm.wrong_model). Before
    every motion the dashboard is asked whether the arm is in remote control (arm.local_control).

    With `control=False` the arm is only looked at: nothing on it is started, set or ended, by `close` neither, and a
    program that runs on it runs on. Everything but reading is then an `InterlockError`.
    """

    def __init__(
        self, name: str, address: str, *, limits: ArmLimits | None = None,
        payload: tuple[float, tuple[float, float, float]] = (0.0, (0.0, 0.0, 0.0)),
        safe_off_outputs: tuple[int, ...] = (), braking: float = 4.0, connect_timeout: float = 10.0,
        forward: Forward | None = None, forward_of: Callable[[LinkTable | None], Forward] | None = None,
        control: bool = True, model: str = "", clock: Clock,
    ) -> None:  # fmt: skip
        self.name = name
        self.limits = limits or ArmLimits()
        self._clock = clock
        self._numbers = itertools.count(1)
        self._starting = threading.Lock()
        self._motion: UrMotion | None = None
        setup = ChildSetup(
            address, clock.rate, tuple(_check_output(name, index) for index in safe_off_outputs),
            payload=self.limits.check_payload(name, payload[0], np.array(payload[1])),
            watchdog=_WATCHDOG_S if clock.rate <= 1.0 else _WATCHDOG_FAST_S,
            braking=check_positive(name, "braking", braking, 20.0, "rad/s^2"), control=control, model=model,
        )  # fmt: skip
        self.factory = read_factory_kinematics(address, min(connect_timeout, _TOLD_S))
        if forward_of is not None:
            forward = forward_of(self.factory.table)
        self._session = ArmSession(
            name, setup, clock, connect_timeout=connect_timeout, forward=forward, unknown=self.factory.missing,
            on_ended=self._on_ended, on_broken=self._end_motion,
        )  # fmt: skip
        self._feed = self._session.feed
        self.statistics = self._session.statistics

    def identity(self) -> Identity:
        """Model, serial number and controller version, asked of the dashboard server."""
        ask = self._session.dashboard.ask
        # Versions before PolyScope 5.6 do not know all of these questions.
        model, serial, version = (
            UNTOLD if unknown(reply := ask(question)) else reply
            for question in ("get robot model", "get serial number", "PolyscopeVersion")
        )
        return Identity(
            model=model,
            serial=serial,
            firmware=version.removeprefix("URSoftware").split("(")[0].strip(),
            address=self._session.setup.address,
        )

    def link_table(self) -> LinkTable | None:
        """The factory's table that the controller computes with, as of the connection; None where it told none."""
        return self.factory.table

    @property
    def untold(self) -> str:
        """Why the controller's table was not known at the connection; "" when it was."""
        return self.factory.missing

    def ping(self) -> float:
        """Ask the dashboard server for the robot mode; the round trip in wall seconds."""
        self._session.require_link()
        begun = time.monotonic()
        self._session.dashboard.ask("robotmode")
        seconds = time.monotonic() - begun
        self.statistics.add_round_trip(seconds)
        return seconds

    def examine(self, seconds: float) -> list[Reading]:
        """How its states come in `seconds`, its supply and its temperatures; see `drivers.arm.health`."""
        self._session.require_link()
        return health.examine(self.name, self._session.setup.address, self._clock, seconds)

    def state(self, max_age: float = 0.1) -> ArmState:
        """The newest state, at most `max_age` s old (or received after the call), else `DeadlineError`."""
        snapshot, _ = self._feed.fresh(max_age)
        return self._state(snapshot)

    @contextmanager
    def record(self) -> Iterator[list[ArmState]]:
        """Every state that arrives while the context is open, in order; see `drivers.interfaces.Arm`."""
        states: list[ArmState] = []
        with self._feed.listening(lambda snapshot: states.append(self._state(snapshot))):
            yield states

    def latch_clock(self) -> Latch:
        """The arm's clock between two host times; see `drivers.interfaces.Arm`."""
        self._session.require_control()
        self._session.require_link()
        return latch_clock(self.name, self._session.setup.address, self._clock, self.statistics.traffic)

    def _state(self, snapshot: Snapshot) -> ArmState:
        safety = _SAFETY[safety_code(snapshot.safety_bits)]
        return ArmState(
            stamp=self._clock.now() - self._feed.age(snapshot), joints=np.array(snapshot.joints),
            joint_speeds=np.array(snapshot.speeds), flange=np.array(snapshot.flange), wrench=np.array(snapshot.wrench),
            safety=safety, reason=late_words(snapshot.late) if safety is ArmSafety.PROTECTIVE_STOP else "",
            moving=not snapshot.at_rest, digital_inputs=snapshot.inputs, digital_outputs=snapshot.outputs,
            device_time=snapshot.device_time, controlled=snapshot.mode == MODE_RUNNING and snapshot.program_running,
        )  # fmt: skip

    def move_joints(self, joints: Vector, speed: float, acceleration: float) -> UrMotion:
        """Straight in joint space to `joints` (rad) at `speed` rad/s of the leading joint."""
        joints = self.limits.check_joints(self.name, joints)
        self.limits.check_joint_move(self.name, speed, acceleration)
        way = np.abs(joints - np.array(self._feed.fresh(0.1)[0].joints))
        leading = max(float(way.max()), 1e-9)
        for index, (part, limit) in enumerate(zip(way, self.limits.joint_speeds, strict=True)):
            check_positive(
                self.name, f"speed of joint {index + 1}", 1e-9 + speed * part / leading, limit + 1e-9, "rad/s"
            )
        return self._start("move to joint angles", "move_joints", _six(joints), float(speed), float(acceleration))

    def move_linear(self, flange: Vector, speed: float, acceleration: float) -> UrMotion:
        """Straight in space to the flange pose (x, y, z, rx, ry, rz) at `speed` m/s."""
        flange = self.limits.check_pose(self.name, flange)
        self.limits.check_linear_move(self.name, speed, acceleration)
        return self._start("straight move", "move_linear", _six(flange), float(speed), float(acceleration))

    def follow(self, times: Vector, joints: Vector, force_limit: float | None = None) -> UrMotion:
        """Stream a joint trajectory: `times` (n,) s of the clock from 0, `joints` (n, 6) rad, straight in between.

        The first point must be where the arm stands (0.02 rad), else `InterlockError`. With `force_limit` (N) the
        motion ends, held at rest and without error, as soon as the force has changed by that much since its start.
        """
        times, joints = self.limits.check_trajectory(self.name, times, joints)
        if force_limit is not None:
            check_positive(self.name, "force limit", force_limit, 500.0, "N")
        gaps = np.abs(joints[0] - np.array(self._feed.fresh(0.1)[0].joints))
        if gaps.max() > _FIRST_POINT:
            gap, joint = shown(float(gaps.max()), "rad"), int(gaps.argmax()) + 1
            raise InterlockError(
                self.name,
                f"the trajectory begins {gap} away from where joint {joint} stands, allowed up to "
                f"{shown(_FIRST_POINT, 'rad')}; nothing was sent. Move to its first point first.",
            )
        points = [tuple(row) for row in joints.tolist()]
        return self._start("trajectory", "follow", times.tolist(), points, force_limit)

    def stop(self) -> None:
        """Bring the arm to rest now, whatever it does, so that nothing of its motion can go on; from any thread.

        Returns when it stands. A program that is paused is ended; `recover` starts it again, and is itself ended by a
        stop. Without its link the arm is stopped and the safe outputs are switched off through the dashboard and a
        process of its own; a `DeviceFault` says when the arm has not shown within 5 s that this was done.
        """
        self._session.stop()

    @contextmanager
    def attended(self) -> Iterator[Callable[[], None]]:
        """While it is open, the child stops what moves once it hears nothing; see `drivers.interfaces.Attended`."""
        self._session.require_control()
        self._session.require_link()
        link = self._session.link
        link.tell("attend", ATTENDED_S)
        try:
            yield lambda: link.tell("attend", ATTENDED_S)
        finally:
            with suppress(DeviceError):
                link.tell("attend", 0.0)

    def zero_force(self) -> None:
        """Take the present wrench as zero."""
        self._session.ask("zero_force")

    def set_payload(self, mass: float, centre: Vector) -> None:
        """Mass in kg and centre of gravity (3,) in the flange frame, m."""
        payload = self.limits.check_payload(self.name, mass, centre)
        self._session.ask("payload", *payload)
        self._session.setup = replace(self._session.setup, payload=payload)

    def set_digital_output(self, index: int, value: bool) -> None:
        """Set a digital output (0-7 standard, 8-15 configurable, 16-17 tool) and return once the arm shows it."""
        self._session.set_output(_check_output(self.name, index), bool(value))

    @contextmanager
    def trying(self, index: int) -> Iterator[None]:
        with self._session.trying(_check_output(self.name, index)):
            yield

    def digital_input(self, index: int) -> bool:
        """Read a digital input (0-7 standard, 8-15 configurable, 16-17 tool) from the newest state."""
        _check_output(self.name, index)
        return bool(self._feed.fresh(0.1)[0].inputs >> index & 1)

    def recover(self, *, confirmed: bool = False) -> None:
        """Start the link and the control program afresh, with the safe outputs off.

        The old program is ended first: an unlocked arm would otherwise finish its old move. A protective stop is
        unlocked only when a person has `confirmed` that this is safe; the maker prohibits it otherwise. Raises
        `DeviceFault` when the stop is one that only the operator can clear, or that nobody has confirmed; `Aborted`
        when `stop` or `close` is called meanwhile: nothing is unlocked or started then, and no process is left behind.
        """
        self._session.recover(confirmed)

    def close(self) -> None:
        """Stop the arm, switch the safe outputs off and end the child process; idempotent, bounded in time."""
        self._session.close()

    def _start(self, what: str, name: str, *arguments: object) -> UrMotion:
        self._session.require_control()
        with self._starting:
            self._session.require_remote()
            self._session.require_ready()
            if self._motion is not None and not self._motion.done:
                raise InterlockError(
                    self.name, "a motion is still under way; nothing was sent. Wait for it or stop it."
                )
            self._session.require_same_arm()
            motion = UrMotion(self.name, what, next(self._numbers), self._clock, self.stop)
            self._motion = motion
            try:
                self._session.ask(name, motion.number, *arguments)
            except (DeviceError, Aborted) as error:
                motion.fail(error)
                raise
            return motion

    def _on_ended(self, ended: Ended) -> None:
        motion = self._motion
        if motion is not None and motion.number == ended.motion:
            motion.pace = ended.pace
            motion.end(ended.how, ended.text)

    def _end_motion(self, error: Exception) -> None:
        if self._motion is not None:
            self._motion.fail(error)


def _six(values: Vector) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _check_output(device: str, index: int) -> int:
    if not (isinstance(index, int) and 0 <= index < _OUTPUTS):
        raise LimitError(
            device, f"digital input or output {index} does not exist: 0-7 standard, 8-15 configurable, 16-17 tool"
        )
    return index
