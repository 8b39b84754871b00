"""The arm driver: a Universal Robots e-series arm with zero TCP, behind ur-rtde in a supervised child process.

Everything is checked here before anything is sent; the child does the talking. A lost child or link is a
`DeviceFault` in every waiting call, after which the arm is stopped and the safe outputs are switched off by other
ways; `recover()` starts afresh.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from drivers.arm.dashboard import Dashboard
from drivers.arm.faults import fault, unlock
from drivers.arm.feed import StateFeed
from drivers.arm.limits import ArmLimits
from drivers.arm.link import ArmLink, switch_off
from drivers.arm.messages import AT_REST, MODE_RUNNING, Ended, Setup, Snapshot, safety_code
from drivers.arm.motion import UrMotion
from drivers.clock import Clock
from drivers.errors import (
    Aborted,
    DeadlineError,
    DeviceError,
    DeviceFault,
    InterlockError,
    LimitError,
    NotConnectedError,
)
from drivers.interfaces import ArmSafety, ArmState, Identity, LinkStatistics, Vector
from drivers.quantities import check_positive, shown

_CALL_S = 5.0
_OUTPUT_S = 1.0
_CLOSE_S = 4.0
_SWITCH_OFF_S, _SWITCH_OFF_LEAST_S = 3.0, 0.3
_FIRST_POINT = 0.02
_WATCHDOG_S = 1.5
_OUTPUTS = 18
_SAFETY = {
    "": ArmSafety.NORMAL,
    "arm.protective_stop": ArmSafety.PROTECTIVE_STOP,
    "arm.safeguard_stop": ArmSafety.SAFEGUARD_STOP,
    "arm.emergency_stop": ArmSafety.EMERGENCY_STOP,
    "arm.safety_fault": ArmSafety.FAULT,
}


class UrArm:
    """A UR arm at `address`; see `drivers.interfaces.Arm` for the promises.

    `payload` is mass in kg and centre of gravity (3,) in the flange frame in m. `safe_off_outputs` are switched off
    when the driver closes or dies, or its link is lost: the laser's output belongs here. `braking` is the deceleration
    of a stop in rad/s². `connect_timeout` is in wall seconds. Raises `NotConnectedError` when no arm answers.
    """

    def __init__(
        self,
        name: str,
        address: str,
        *,
        limits: ArmLimits | None = None,
        payload: tuple[float, tuple[float, float, float]] = (0.0, (0.0, 0.0, 0.0)),
        safe_off_outputs: tuple[int, ...] = (),
        braking: float = 4.0,
        connect_timeout: float = 10.0,
        clock: Clock,
    ) -> None:
        self.name = name
        self.limits = limits or ArmLimits()
        self.statistics = LinkStatistics()
        self._address = address
        self._clock = clock
        self._connect_timeout = connect_timeout
        self._payload = self.limits.check_payload(name, payload[0], np.array(payload[1]))
        self._safe_off = tuple(_check_output(name, index) for index in safe_off_outputs)
        self._braking = check_positive(name, "braking", braking, 20.0, "rad/s^2")
        self._dashboard = Dashboard(name, address)
        self._numbers = itertools.count(1)
        self._feed = StateFeed(name, clock, lambda: self._link.lost is not None, self._alive, self.statistics)
        self._starting = threading.Lock()
        self._motion: UrMotion | None = None
        self._safing: threading.Thread | None = None
        self._closed = False
        self._link = self._connect()

    # --- who and how ---

    def identity(self) -> Identity:
        """Model, serial number and controller version, asked of the dashboard server."""
        version = self._dashboard.ask("PolyscopeVersion")
        return Identity(
            model=self._dashboard.ask("get robot model"),
            serial=self._dashboard.ask("get serial number"),
            firmware=version.removeprefix("URSoftware").split("(")[0].strip(),
            address=self._address,
        )

    def ping(self) -> float:
        """Ask the dashboard server for the robot mode; the round trip in wall seconds."""
        self._alive()
        begun = time.monotonic()
        self._dashboard.ask("robotmode")
        seconds = time.monotonic() - begun
        self.statistics.add_round_trip(seconds)
        return seconds

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

    def _state(self, snapshot: Snapshot) -> ArmState:
        return ArmState(
            stamp=self._clock.now() - self._feed.age(snapshot),
            joints=np.array(snapshot.joints),
            joint_speeds=np.array(snapshot.speeds),
            flange=np.array(snapshot.flange),
            wrench=np.array(snapshot.wrench),
            safety=_SAFETY[safety_code(snapshot.safety_bits)],
            moving=max(abs(speed) for speed in snapshot.speeds) >= AT_REST,
            digital_inputs=snapshot.inputs,
            digital_outputs=snapshot.outputs,
            device_time=snapshot.device_time,
        )

    # --- moving ---

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
        """Bring the arm to rest now, whatever it does; returns when it stands. Callable from any thread."""
        self._ask("stop")

    # --- settings, inputs and outputs ---

    def zero_force(self) -> None:
        """Take the present wrench as zero."""
        self._ask("zero_force")

    def set_payload(self, mass: float, centre: Vector) -> None:
        """Mass in kg and centre of gravity (3,) in the flange frame, m."""
        payload = self.limits.check_payload(self.name, mass, centre)
        self._ask("payload", *payload)
        self._payload = payload

    def set_digital_output(self, index: int, value: bool) -> None:
        """Set a digital output (0-7 standard, 8-15 configurable, 16-17 tool) and return once the arm shows it."""
        _check_output(self.name, index)
        self._ask("output", index, bool(value), deadline=_OUTPUT_S)
        if not self._feed.wait_for(lambda snapshot: bool(snapshot.outputs >> index & 1) == bool(value), _OUTPUT_S):
            self.statistics.count("output not shown")
            raise DeadlineError(
                self.name,
                f"output {index} was set to {bool(value)}, but the arm did not show it within {shown(_OUTPUT_S, 's')}. "
                "See that no other program sets this output.",
            )

    def digital_input(self, index: int) -> bool:
        """Read a digital input (0-7 standard, 8-15 configurable, 16-17 tool) from the newest state."""
        _check_output(self.name, index)
        return bool(self._feed.fresh(0.1)[0].inputs >> index & 1)

    # --- ends and new beginnings ---

    def recover(self) -> None:
        """Clear a protective stop and start the link and the control program afresh.

        The old program is ended first: an unlocked arm would otherwise finish its old move. Raises `DeviceFault` when
        the stop is one that only the operator can clear.
        """
        if self._closed:
            raise NotConnectedError(self.name, "the driver was closed. Open a new one.")
        self._dashboard.ask("stop")
        unlock(self.name, self._dashboard, self._clock)
        self._link.close(_CLOSE_S)
        self._end_motion(fault(self.name, "arm.program_stopped", "the arm was recovered"))
        self._join_safing()
        self._feed.forget()
        self._link = self._connect()
        self._require_ready()

    def close(self) -> None:
        """Stop the arm, switch the safe outputs off and end the child process; idempotent, bounded in time."""
        if self._closed:
            return
        self._closed = True
        self._link.close(_CLOSE_S)
        self._end_motion(NotConnectedError(self.name, "the driver was closed"))
        self._join_safing()
        self._dashboard.close()

    # --- inside ---

    def _connect(self) -> ArmLink:
        setup = Setup(self._address, self._clock.rate, self._safe_off, self._payload, _WATCHDOG_S, self._braking)
        return ArmLink(self.name, setup, self._connect_timeout, self._feed.take, self._on_ended, self._on_lost)

    def _alive(self) -> None:
        if self._closed:
            raise NotConnectedError(self.name, "the driver was closed. Open a new one.")
        if self._link.lost is not None:
            raise self._link.lost

    def _ask(self, name: str, *arguments: Any, deadline: float = _CALL_S) -> None:
        self._alive()
        problem = self._link.call(name, *arguments, deadline=deadline)
        if problem is not None:
            if problem[0] == "arm.stopped":
                raise Aborted(f"{self.name}: {name} was dropped because the arm was stopped")
            raise fault(self.name, *problem)

    def _start(self, what: str, name: str, *arguments: Any) -> UrMotion:
        with self._starting:
            self._require_ready()
            if self._motion is not None and not self._motion.done:
                raise InterlockError(
                    self.name, "a motion is still under way; nothing was sent. Wait for it or stop it."
                )
            motion = UrMotion(self.name, what, next(self._numbers), self._clock, self.stop)
            self._motion = motion
            try:
                self._ask(name, motion.number, *arguments)
            except (DeviceError, Aborted) as error:
                motion.fail(error)
                raise
            return motion

    def _require_ready(self) -> None:
        """Raise the `DeviceFault` that keeps the arm from moving, if any."""
        snapshot, _ = self._feed.fresh(0.1)
        if code := safety_code(snapshot.safety_bits):
            raise fault(self.name, code)
        if snapshot.mode != MODE_RUNNING:
            raise fault(self.name, "arm.not_powered")
        if not snapshot.program_running:
            raise fault(self.name, "arm.program_stopped")

    def _on_ended(self, ended: Ended) -> None:
        motion = self._motion
        if motion is not None and motion.number == ended.motion:
            motion.end(ended.how, ended.text)

    def _on_lost(self, error: DeviceFault) -> None:
        self.statistics.count("link lost")
        self._safing = threading.Thread(target=self._make_safe, name=f"{self.name} make safe", daemon=True)
        self._safing.start()
        self._end_motion(error)
        self._feed.wake()

    def _make_safe(self) -> None:
        """Without the child: end the arm's program, which stops it, and switch the safe outputs off."""
        try:
            Dashboard(self.name, self._address).ask("stop")
        except DeviceError:
            self.statistics.count("emergency stop of the program failed")
        end = time.monotonic() + _SWITCH_OFF_S
        while self._safe_off and (left := end - time.monotonic()) > _SWITCH_OFF_LEAST_S:
            if switch_off(self._address, self._safe_off, deadline=min(2.0, left)):
                return
            self.statistics.count("emergency switching of outputs failed")

    def _join_safing(self) -> None:
        if self._safing is not None:
            self._safing.join(_SWITCH_OFF_S + 1.0)

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
