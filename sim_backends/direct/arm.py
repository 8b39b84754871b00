"""The arm in this process: trajectories are streamed into the model as a driver on a wire streams them.

A protective stop waits for a person's word, an emergency stop for the power.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from drivers.arm.faults import fault
from drivers.arm.limits import ArmLimits
from drivers.clock import Clock, Latch
from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, InterlockError, LimitError, check_range
from drivers.interfaces import ArmSafety, ArmState, Identity, LinkTable, Vector
from sim_backends.direct.switches import DirectDevice
from sim_backends.models.arm import ArmModel, Power, Safety
from sim_backends.models.arm_kinematics import matrix_from_pose, pose_from_matrix
from sim_backends.models.arm_motion import JointMove, LinearMove, Servo, SimulatedMotion, StopMotion

TICK_S, GUARDED_TICK_S, STILL_TICK_S = 0.02, 0.004, 0.05
AT_REST = 0.003
"""An arm whose joints all turn slower than this, rad/s, stands."""
_SERVO_LAG_S = 0.03
"""Of a look-ahead of 0.05 s and a gain of 500."""
_SERVO_BRAKING = 10.0
_ARRIVED = 2e-3
_TIMEOUT_S = 3.0


class ArmMove:
    """A motion that the controller ends by itself; `motion` is the model's."""

    tick_s = TICK_S

    def __init__(self, arm: "DirectArm", motion: SimulatedMotion) -> None:
        self.contact = False
        self.motion = motion
        self._arm = arm
        self._error: CellError | None = None
        self._done = False

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        return self._done

    def wait(self, timeout: float) -> None:
        """Let time pass until the motion has ended; see `drivers.interfaces.Motion`."""
        clock = self._arm.clock
        deadline = clock.now() + timeout
        while not self._done:
            if clock.now() > deadline:
                self._arm.stop()
                self._error = DeadlineError(
                    self._arm.name,
                    f"the motion did not end within {timeout:.3g} s and was stopped. See what hinders it",
                )
                break
            clock.sleep(self.tick_s)
        if self._error is not None:
            raise self._error

    def fail(self, error: CellError) -> None:
        """End it with an error."""
        self._error, self._done = error, True

    def before_tick(self, t: float) -> None:
        """The model goes on by itself."""

    def after_tick(self, t: float) -> None:
        """Ended, once the model is idle and the joints stand."""
        model = self._arm.model
        if (found := self._arm.trouble()) is not None:
            self.fail(found)
        elif model.idle and not model.moving:
            self._done = True
            self._arm.rests.append(model.drive.q.copy())


class Streamed(ArmMove):
    """A joint trajectory that is streamed into a servo, with a force limit or without."""

    def __init__(
        self, arm: "DirectArm", times: Vector, joints: Vector, force_limit: float | None, force_before: Vector
    ) -> None:
        self._servo = Servo(joints[0], _SERVO_LAG_S)
        super().__init__(arm, self._servo)
        self._times, self._joints = times, joints
        self._force_limit, self._force_before = force_limit, force_before
        self._begun = arm.clock.now()
        self._ending = False
        self.tick_s = TICK_S if force_limit is None else GUARDED_TICK_S

    def before_tick(self, t: float) -> None:
        """Stream where the trajectory is at `t`."""
        if not self._ending:
            elapsed = t - self._begun
            after = min(int(np.searchsorted(self._times, elapsed, side="right")), len(self._times) - 1)
            begin, end = self._times[after - 1], self._times[after]
            part = min(1.0, (elapsed - begin) / (end - begin))
            self._servo.target = self._joints[after - 1] + part * (self._joints[after] - self._joints[after - 1])

    def after_tick(self, t: float) -> None:
        """Contact, arrival, or the end of the patience with it."""
        model = self._arm.model
        if self._ending or model.safety is not Safety.NORMAL:
            super().after_tick(t)
            return
        late = t - self._begun - self._times[-1]
        if self._force_limit is not None:
            change = model.felt[:3] - self._force_before
            self.contact = bool(np.linalg.norm(change) > self._force_limit)
        off = float(np.abs(model.drive.q - self._joints[-1]).max())
        arrived = late >= 0 and off < _ARRIVED and float(np.abs(model.drive.qd).max()) < AT_REST
        if late > _TIMEOUT_S:
            self.fail(self._arm.fault("arm.not_arrived", f"a joint is {off:.4f} rad off"))
        elif arrived or self.contact:
            self._ending = True
            model.start(StopMotion(_SERVO_BRAKING, linear=True))


_BRAKING = 4.0
_FIRST_POINT = 0.02
_LATCH_S = 0.0005
"""A round trip."""
_FORCE_SAMPLES, _FORCE_SAMPLE_S = 10, 0.006
_OUTPUTS = 18
_MOST_FORCE = 500.0
_SAFETY = {
    Safety.NORMAL: ArmSafety.NORMAL,
    Safety.PROTECTIVE_STOP: ArmSafety.PROTECTIVE_STOP,
    Safety.SAFEGUARD_STOP: ArmSafety.SAFEGUARD_STOP,
    Safety.EMERGENCY_STOP: ArmSafety.EMERGENCY_STOP,
}


class DirectArm(DirectDevice):
    """The arm `model`; see `drivers.interfaces.Arm` for the promises."""

    def __init__(
        self, name: str, model: ArmModel, clock: Clock, *, limits: ArmLimits, safe_off: tuple[int, ...]
    ) -> None:
        """Outputs in `safe_off` go off at a recovery and at the end."""
        super().__init__(name)
        self.model = model
        self.clock = clock
        self.rests: list[Vector] = []
        """Joint angles (6,), rad, at the end of each motion so far."""
        self._limits, self._safe_off = limits, safe_off
        self._motion: ArmMove | None = None
        self.late = 0.0
        """By how many seconds each state comes later than the controller measured it."""
        self._recorded: list[ArmState] | None = None
        self._stops = 0
        self._tried: list[int] = []

    def identity(self) -> Identity:
        """The model's own plate."""
        return Identity(self.model.params.model, self.model.params.serial, "virtual", "in this process")

    def link_table(self) -> LinkTable:
        """What the model's controller computes with."""
        a, d, alpha, theta = self.model.params.dh.T.tolist()
        return LinkTable(tuple(theta), tuple(a), tuple(d), tuple(alpha))

    def state(self, max_age: float = 0.1) -> ArmState:
        """What the encoders, the force sensor and the inputs show now."""
        model = self.model
        speeds = model.drive.qd.copy()
        return ArmState(
            stamp=self.clock.now() + self.late, joints=model.drive.q.copy(), joint_speeds=speeds,
            flange=pose_from_matrix(model.reported_flange()), wrench=model.felt.copy(), safety=_SAFETY[model.safety],
            moving=bool(np.abs(speeds).max() >= AT_REST), digital_inputs=model.digital_inputs,
            digital_outputs=model.digital_outputs, device_time=self.clock.now(),
            controlled=model.power is Power.RUNNING, reason=model.fault_text,
        )  # fmt: skip

    @contextmanager
    def record(self) -> Iterator[list[ArmState]]:
        """The states at each tick while the context is open; the device's clock is the world's."""
        self._recorded = []
        try:
            yield self._recorded
        finally:
            self._recorded = None

    def latch_clock(self) -> Latch:
        """The world's clock, told as late as the states are."""
        asked = self.clock.now()
        self.clock.sleep(_LATCH_S + self.late)
        return Latch(asked, asked + 0.5 * _LATCH_S, self.clock.now())

    def move_joints(self, joints: Vector, speed: float, acceleration: float) -> ArmMove:
        """Straight in joint space to `joints` (rad) at `speed` rad/s of the leading joint."""
        joints = self._limits.check_joints(self.name, joints)
        self._limits.check_joint_move(self.name, speed, acceleration)
        self._require_free()
        return self._begin(ArmMove(self, JointMove(joints, speed, acceleration)))

    def move_linear(self, flange: Vector, speed: float, acceleration: float) -> ArmMove:
        """Straight in space to the flange pose (x, y, z, rx, ry, rz) at `speed` m/s."""
        target = matrix_from_pose(self._limits.check_pose(self.name, flange))
        self._limits.check_linear_move(self.name, speed, acceleration)
        self._require_free()
        return self._begin(ArmMove(self, LinearMove(target, speed, acceleration)))

    def follow(self, times: Vector, joints: Vector, force_limit: float | None = None) -> ArmMove:
        """Stream a joint trajectory; see `drivers.interfaces.Arm`."""
        times, joints = self._limits.check_trajectory(self.name, times, joints)
        if force_limit is not None:
            check_range(self.name, "force limit", force_limit, low=1e-9, high=_MOST_FORCE, unit="N")
        gap = float(np.abs(joints[0] - self.model.drive.q).max())
        if gap > _FIRST_POINT:
            raise InterlockError(
                self.name,
                f"the trajectory begins {gap:.3f} rad away from where the arm stands, allowed up to {_FIRST_POINT} "
                "rad; nothing was sent. Move to its first point first.",
            )
        self._require_free()
        before = self._mean_force() if force_limit is not None else np.zeros(3)
        return self._begin(Streamed(self, times, joints, force_limit, before))

    def zero_force(self) -> None:
        """Take the present wrench as zero."""
        self._require_well()
        self.model.zero_force()

    def set_payload(self, mass: float, centre: Vector) -> None:
        """Tell the model what it carries."""
        mass, offset = self._limits.check_payload(self.name, mass, centre)
        self._require_well()
        self.model.payload = (mass, np.array(offset))

    def set_digital_output(self, index: int, value: bool) -> None:
        """Set an output and let a tick pass, in which the world follows it."""
        self._check_index(index)
        self.model.write_digital_outputs(1 << index, int(value) << index)
        self.clock.sleep(TICK_S)

    @contextmanager
    def trying(self, index: int) -> Iterator[None]:
        """See `drivers.interfaces.TriesOutputs`."""
        self._check_index(index)
        self._tried.append(index)
        try:
            yield
        finally:
            self._tried.remove(index)

    def digital_input(self, index: int) -> bool:
        """What is wired to input `index`."""
        self._check_index(index)
        return bool(self.model.digital_inputs >> index & 1)

    def recover(self, *, confirmed: bool = False) -> None:
        """Unlock a protective stop that a person has `confirmed`, which takes its time; the safe outputs go off. Ended
        by `stop()`, with `Aborted`."""
        stops = self._stops
        self._require_remote()
        for index in (*self._safe_off, *self._tried):
            self.set_digital_output(index, False)
        if self.model.safety is Safety.PROTECTIVE_STOP:
            if not confirmed:
                raise self.fault("arm.protective_stop", "nobody has confirmed that it may be unlocked")
            self.clock.sleep(self.model.params.unlock_delay)
            if self._stops != stops:
                raise Aborted(f"{self.name}: stopped while it was recovered")
            self.model.unlock()
        self._require_well()
        self._motion = None

    def stop(self) -> None:
        """Brake now, unless the safety system brakes already, and wait until the arm stands."""
        self._stops += 1
        self.end_motion(Aborted(f"{self.name}: stopped before the end of its motion"))
        if self.model.safety is Safety.NORMAL:
            self.model.start(StopMotion(_BRAKING))
        while self.model.moving:
            self.clock.sleep(TICK_S)

    def close(self) -> None:
        """Stop; the safe outputs go off."""
        self.stop()
        for index in (*self._safe_off, *self._tried):
            self.set_digital_output(index, False)

    def fault(self, code: str, text: str) -> DeviceFault:
        """The fault of a code, in the driver's words."""
        return fault(self.name, code, text)

    def trouble(self) -> DeviceFault | None:
        """What keeps a program from moving the arm now, or None."""
        if self.model.safety is not Safety.NORMAL:
            return self.fault(f"arm.{self.model.safety.name.lower()}", self.model.fault_text)
        if self.model.power is not Power.RUNNING:
            return self.fault("arm.not_powered", f"its power is {self.model.power.name.lower()}")
        return None

    def end_motion(self, error: Aborted) -> None:
        """End the motion that is under way, if any, with an error."""
        if self._motion is not None and not self._motion.done:
            self._motion.fail(error)

    @property
    def tick_s(self) -> float:
        """Fine while it moves, finest while it feels for contact."""
        if self._motion is None or self._motion.done:
            return STILL_TICK_S if self.model.idle and not self.model.moving else TICK_S
        return self._motion.tick_s

    def before_tick(self, t: float) -> None:
        """Stream the target of time `t`."""
        if self._motion is not None and not self._motion.done:
            self._motion.before_tick(t)

    def after_tick(self, t: float) -> None:
        """See whether the motion has ended."""
        if self._recorded is not None:
            self._recorded.append(self.state())
        if self._motion is not None and not self._motion.done:
            self._motion.after_tick(t)

    def _check_index(self, index: int) -> None:
        if not 0 <= index < _OUTPUTS:
            which = "0-7 standard, 8-15 configurable, 16-17 tool"
            raise LimitError(self.name, f"digital input or output {index} does not exist: {which}")

    def _require_well(self) -> None:
        self._require_remote()
        if (found := self.trouble()) is not None:
            raise found

    def _require_free(self) -> None:
        self._require_well()
        if self._motion is not None and not self._motion.done:
            raise InterlockError(self.name, "a motion is still under way; nothing was sent. Wait for it or stop it.")

    def _require_remote(self) -> None:
        if not self.model.remote:
            raise self.fault("arm.local_control", "it takes nothing but questions from others")

    def _begin(self, motion: ArmMove) -> ArmMove:
        self._require_free()
        self.model.start(motion.motion)
        self._motion = motion
        return motion

    def _mean_force(self) -> Vector:
        samples = []
        for _ in range(_FORCE_SAMPLES):
            self.clock.sleep(_FORCE_SAMPLE_S)
            samples.append(self.model.felt[:3])
        return np.asarray(np.mean(samples, axis=0))
