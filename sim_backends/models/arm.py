"""The simulated arm: joints, safety system, inputs and outputs, true and reported poses; physics only, no bytes.

What the arm reports comes from its joint encoders and the table that its controller was given in the factory. Where the
flange truly is differs by what that calibration has left, and by a repeatability error that is drawn anew for every
rest.
"""

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum
from typing import Any, Self

import numpy as np

from sim_backends.clock import WorldClock
from sim_backends.models.arm_kinematics import (
    GRAVITY,
    TABLES,
    UR10E_DH,
    JointErrors,
    Kinematics,
    Matrix,
    TruePose,
    Vector,
)
from sim_backends.models.arm_motion import JointDrives, MotionError, SimulatedMotion, StopMotion

Contact = Callable[[Matrix], Vector]
"""Wrench (6,) on the arm at the flange, base axes, N and N·m, for a true base_from_flange (4, 4)."""

FAULTS = ("protective_stop", "safeguard_stop", "emergency_stop", "reduced_mode", "local_control")
_BRAKE = 20.0
_REST_SPEED = 1e-4
_FINE_STEP = 0.004


class Safety(Enum):
    """State of the safety system."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    EMERGENCY_STOP = 7


class Power(IntEnum):
    """State of the joints' power and brakes, with the controller's numbers."""

    OFF = 3
    IDLE = 5
    RUNNING = 7


_SMALL, _MIDDLE = (180.0, 180.0, 180.0, 360.0, 360.0, 360.0), (180.0,) * 6
_LONG, _HEAVY = (120.0, 120.0, 180.0, 180.0, 180.0, 180.0), (120.0, 120.0, 150.0, 210.0, 210.0, 210.0)
SPEED_LIMITS = {
    **dict.fromkeys(("UR3", "UR3e"), _SMALL),
    **dict.fromkeys(("UR5", "UR5e", "UR7e"), _MIDDLE),
    **dict.fromkeys(("UR10", "UR10e", "UR12e", "UR16e"), _LONG),
    **dict.fromkeys(("UR20", "UR30"), _HEAVY),
}
"""The fastest that each joint may turn, deg/s, by the name of the model. Source: the maker's joint limits."""


@dataclass(frozen=True)
class ArmParams:
    """What one particular arm is like.

    `dh` and `dh_error` are (6, 4): a in m, d in m, alpha in rad, joint offset in rad. `dh` is what the controller
    computes with and tells; the error is the true table less that one. `repeatability` holds standard deviations
    per axis in m and rad; `force_noise` in N and N·m; `force_limit` in N is where a protective stop comes;
    `unlock_delay` in s is how long it cannot be unlocked. `memory` in rad is the joints' way over which the
    error of repeatability lasts (0: drawn at each rest); for `harmonics` and `compliance` see `JointErrors`; `carried`
    in kg, its centre of gravity in m in the flange frame.
    """

    dh: Matrix = field(default_factory=lambda: UR10E_DH.copy())
    dh_error: Matrix = field(default_factory=lambda: np.zeros((6, 4)))
    repeatability: tuple[float, float] = (0.0, 0.0)
    memory: float = 0.0
    harmonics: Matrix = field(default_factory=lambda: np.zeros((6, 4)))
    compliance: float = 0.0
    carried: float = 2.1
    carried_centre: tuple[float, float, float] = (0.0, 0.0, 0.06)
    blend_time: float = 0.3
    joint_limit: float = 2 * math.pi
    speed_limits: Vector = field(default_factory=lambda: np.radians(_LONG))
    tracking_lag: float = 0.02
    initial_q: Vector = field(default_factory=lambda: np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0]))
    force_noise: tuple[float, float] = (0.0, 0.0)
    force_limit: float = 150.0
    unlock_delay: float = 5.0
    model: str = "UR10e"
    serial: str = "20235500001"

    @classmethod
    def of(cls, model: str, **others: Any) -> Self:
        """Those of the maker's `model`, a key of `TABLES`, with `others` as given."""
        given = {"dh": TABLES[model].copy(), "speed_limits": np.radians(SPEED_LIMITS[model]), **others}
        return cls(model=model, **given)


class ArmModel:
    """A simulated six-axis arm; `tick` advances it, every other call may come from another thread."""

    def __init__(self, params: ArmParams, rng: np.random.Generator, clock: WorldClock) -> None:
        """Stands at `params.initial_q`, powered, brakes released, safety normal."""
        self.params = params
        self.kinematics = Kinematics(params.dh)
        self._drawn = Kinematics(TABLES[params.model])
        self.drive = JointDrives(self.kinematics, params.speed_limits, np.array(params.initial_q, float), np.zeros(6))
        self.power = Power.RUNNING
        self.safety = Safety.NORMAL
        self.reduced = False
        """Whether the safety system's tighter limits hold: the arm works on as in normal mode."""
        self.remote = True
        """Remote control, as against local control at the pendant, in which others only look."""
        self.fault_text = ""
        self.contact: Contact | None = None
        self.digital_outputs = 0
        self.digital_inputs = 0
        self.payload = (params.carried, np.array(params.carried_centre))
        """What the controller was told that it carries; at power-on its installation's, which is right."""
        self.wrench = np.zeros(6)
        self.time = clock.now()
        self._speed_limits = (1.02 * params.speed_limits).tolist()
        self._rng = rng
        self._lock = threading.RLock()
        self._queue: deque[SimulatedMotion] = deque()
        self._begun = False
        self._suspended: list[SimulatedMotion] = []
        self._stopped_at = -math.inf
        self._rest_since = self.time
        self._force_zero = np.zeros(6)
        self._untold: tuple[Vector, tuple[float, Vector], Vector] | None = None
        self._truth = self._true_pose(params.dh)
        self._truth.update(self.time, 0.0, self.drive.q, moving=False)

    def shift_zero(self, joint: int, angle: float) -> None:
        """As if the zero of `joint`, 0 to 5, had moved by `angle`, rad, and the controller did not know."""
        with self._lock:
            error = self.params.dh_error.copy()
            error[joint, 3] += angle
            self.params = replace(self.params, dh_error=error)
            self._truth = self._true_pose(self.params.dh)
            self._truth.update(self.time, 0.0, self.drive.q, moving=False)

    def tick(self, t: float) -> None:
        """Advance the arm to world time `t`; a time that is not later than the last one changes nothing."""
        with self._lock:
            dt = t - self.time
            if dt <= 0:
                return
            self.time = t
            if self.power is Power.RUNNING:
                self._advance(dt)
            moving = self.moving
            if moving:
                self._rest_since = math.inf
            elif self._rest_since == math.inf:
                self._rest_since = t
            self._truth.update(t, dt, self.drive.q, moving)
            self._feel()
            noise = self.params.force_noise
            if noise[0] or noise[1]:
                scatter = self._rng.normal(size=6)
                scatter[:3] *= noise[0]
                scatter[3:] *= noise[1]
                self.wrench = self.drive.wrench + scatter
            else:
                self.wrench = self.drive.wrench

    def base_from_flange(self, t: float) -> Matrix:
        """True flange pose (4, 4) in the base at world time `t` (the last 10 s are kept)."""
        return self._truth.at(t)

    def body_frames(self) -> Matrix:
        """The frames (7, 4, 4) of base, links and flange as the maker draws them, now; those of the links to some mm. A
        factory's table has them where its common normals happen to lie, which may be far from the links."""
        frames = self._drawn.frames(self.drive.q)
        frames[6] = self.reported_flange()
        return frames

    def reported_flange(self) -> Matrix:
        """Flange pose (4, 4) in the base as the controller computes it from the encoders, now."""
        return self.kinematics.forward(self.drive.q)

    def set_digital_input(self, index: int, value: bool) -> None:
        """Set what is wired to digital input `index` (0-7 standard, 8-15 configurable, 16-17 tool)."""
        if not 0 <= index <= 17:
            raise ValueError(f"digital input {index} must be within 0…17")
        with self._lock:
            self.digital_inputs = self.digital_inputs & ~(1 << index) | int(value) << index

    def fault(self, name: str) -> None:
        """Bring about one of `FAULTS`; ValueError for any other name."""
        if name == "protective_stop":
            self.protective_stop("triggered from outside")
        elif name == "safeguard_stop":
            with self._lock:
                if self.safety is Safety.NORMAL:
                    self.safety = Safety.SAFEGUARD_STOP
                    self.fault_text = "safeguard open"
                    self.suspend()
        elif name == "emergency_stop":
            with self._lock:
                self.safety = Safety.EMERGENCY_STOP
                self.fault_text = "emergency stop pressed"
                self._suspended = []
                self._replace(StopMotion(_BRAKE))
        elif name == "reduced_mode":
            self.reduced = True
        elif name == "local_control":
            self.remote = False
        else:
            raise ValueError(f"arm fault {name!r} is unknown: use {', '.join(FAULTS)}")

    def clear(self) -> None:
        """Take away the cause: a protective or safeguard stop ends at once, an emergency stop leaves the power off."""
        with self._lock:
            self.reduced, self.remote = False, True
            if self.safety is Safety.EMERGENCY_STOP:
                self.power = Power.OFF
            self.safety = Safety.NORMAL
            self.fault_text = ""

    @property
    def ready(self) -> bool:
        """True when a program may move the arm."""
        return self.power is Power.RUNNING and self.safety is Safety.NORMAL

    @property
    def safety_mode(self) -> int:
        """The controller's number for the state of the safety system: 2 is normal with reduced limits."""
        return 2 if self.reduced and self.safety is Safety.NORMAL else self.safety.value

    @property
    def motion(self) -> SimulatedMotion | None:
        """The motion under way."""
        return self._queue[0] if self._queue else None

    @property
    def idle(self) -> bool:
        """True when no motion is under way."""
        return not self._queue

    def pending(self, motion: SimulatedMotion) -> bool:
        """True until `motion` has ended or something else has taken its place."""
        return any(one is motion for one in self._queue)

    @property
    def moving(self) -> bool:
        """True while a joint turns."""
        return bool(max(map(abs, self.drive.qd.tolist())) > _REST_SPEED)

    @property
    def steady(self) -> bool:
        """True once the arm has been at rest for 0.1 s."""
        return self.time - self._rest_since > 0.1

    @property
    def felt(self) -> Vector:
        """Wrench (6,) as reported: at the flange in base axes, with noise, less the wrench taken as zero. The
        controller takes the weight away that it was told of; what it carries beyond that is felt."""
        return self.wrench + self._untold_weight() - self._force_zero

    def start(self, motion: SimulatedMotion) -> None:
        """Begin `motion` in place of any other; one that begins from rest is preceded by a stop if need be."""
        with self._lock:
            self._replace(motion)

    def suspend(self) -> None:
        """Stop in such a way that `resume` continues the motion."""
        with self._lock:
            if not self._suspended:
                self._suspended = [m for m in self._queue if not isinstance(m, StopMotion)]
            self._replace(StopMotion(_BRAKE))

    def resume(self) -> None:
        """Continue the suspended motion, if there is one."""
        with self._lock:
            motions, self._suspended = self._suspended, []
            if motions:
                self._queue = deque(motions)
                self._begun = False

    def halt(self) -> None:
        """Stop and forget every motion."""
        with self._lock:
            self._suspended = []
            self._replace(StopMotion(_BRAKE))

    def zero_force(self) -> None:
        """Take the present wrench as zero."""
        with self._lock:
            self._force_zero = self.drive.wrench + self._untold_weight()

    def write_digital_outputs(self, mask: int, values: int) -> None:
        """Set the outputs named by the bits of `mask` to those of `values` (bits 0-7, 8-15 and 16-17)."""
        with self._lock:
            self.digital_outputs = self.digital_outputs & ~mask | values & mask

    def protective_stop(self, reason: str) -> None:
        """Stop the arm for `reason` until the stop is unlocked; ignored while an emergency stop holds."""
        with self._lock:
            if self.safety is not Safety.NORMAL:
                return
            self.safety = Safety.PROTECTIVE_STOP
            self.fault_text = reason
            self._stopped_at = self.time
            self.suspend()

    def unlock(self, at_once: bool = False) -> bool:
        """Release a protective stop; False while it is younger than `unlock_delay`, unless `at_once`. The dashboard
        makes its clients wait; the primary port does not."""
        with self._lock:
            if self.safety is Safety.PROTECTIVE_STOP:
                if not at_once and self.time - self._stopped_at < self.params.unlock_delay:
                    return False
                self.safety = Safety.NORMAL
                self.fault_text = ""
            return True

    def set_power(self, power: Power) -> bool:
        """Switch the power; False when the safety system does not allow it."""
        with self._lock:
            if power is not Power.OFF and self.safety is not Safety.NORMAL:
                return False
            if power is not Power.RUNNING:
                self._queue.clear()
                self._suspended = []
                self.drive.qd = np.zeros(6)
            self.power = power
            return True

    def _untold_weight(self) -> Vector:
        """Wrench (6,) at the flange in base axes of the weight that the controller was not told of."""
        q, payload = self.drive.q, self.payload
        known = self._untold
        # Several packets of a tick tell it, and it changes only when the arm turns or is told of another load.
        if known is not None and known[0] is q and known[1] is payload:
            return known[2]
        wrench = self._weight_beyond(payload)
        self._untold = (q, payload, wrench)
        return wrench

    def _weight_beyond(self, payload: tuple[float, Vector]) -> Vector:
        mass, centre = payload
        params = self.params
        if mass == params.carried and tuple(centre) == params.carried_centre:
            return np.zeros(6)
        moment = params.carried * np.array(params.carried_centre) - mass * np.asarray(centre)
        x, y, _ = (self.reported_flange()[:3, :3] @ moment).tolist()
        # That arm crossed with the weight, which points straight down.
        return np.array([0.0, 0.0, -(params.carried - mass) * GRAVITY, -y * GRAVITY, x * GRAVITY, 0.0])

    def _true_pose(self, table: Matrix) -> TruePose:
        params = self.params
        true = Kinematics(table + params.dh_error)
        bends = params.harmonics.any() or params.compliance > 0.0
        joints = JointErrors(true, params.harmonics, params.compliance, params.carried) if bends else None
        return TruePose(true, params.repeatability, params.blend_time, self._rng, joints=joints, memory=params.memory)

    def _replace(self, motion: SimulatedMotion) -> None:
        self._queue = deque([StopMotion(_BRAKE), motion] if motion.from_rest and self.moving else [motion])
        self._begun = False

    def _advance(self, dt: float) -> None:
        if not self._queue:
            return
        steps = math.ceil(dt / _FINE_STEP) if self._queue[0].feels_force else 1
        for _ in range(steps):
            self._step(dt / steps)
            if steps > 1:
                self._feel()
        if self.safety is Safety.EMERGENCY_STOP and not self._queue:
            self.power = Power.OFF

    def _step(self, dt: float) -> None:
        if not self._queue:
            return
        before = self.drive.q
        try:
            if not self._begun:
                self._queue[0].begin(self.drive)
                self._begun = True
            motion = self._queue[0]
            ended = motion.step(self.drive, dt)
        except MotionError as error:
            self.protective_stop(str(error))
            return
        self._check_limits(before)
        if ended and self.motion is motion:
            self._queue.popleft()
            self._begun = False

    def _check_limits(self, before: Vector) -> None:
        drive, params = self.drive, self.params
        q, qd = drive.q.tolist(), drive.qd.tolist()
        for joint in range(6):
            if not abs(q[joint]) <= params.joint_limit:
                drive.q, drive.qd = before, np.zeros(6)
                self.protective_stop(f"joint {joint} at its limit of ±{math.degrees(params.joint_limit):.0f}°")
                return
            if abs(qd[joint]) > self._speed_limits[joint] and not isinstance(self.motion, StopMotion):
                drive.q = before
                drive.qd = np.clip(drive.qd, -params.speed_limits, params.speed_limits)
                self.protective_stop(f"joint {joint} faster than its limit of {params.speed_limits[joint]:.2f} rad/s")
                return

    def _feel(self) -> None:
        if self.contact is None:
            return
        self.drive.wrench = np.asarray(self.contact(self._truth.look(self.drive.q)), dtype=float)
        force = math.hypot(*self.drive.wrench[:3])
        if force > self.params.force_limit:
            self.protective_stop(f"force of {force:.0f} N exceeds {self.params.force_limit:.0f} N")
