"""The commands of ur_rtde's control script by number, and what they share: registers, signals, who moves the arm.

A command is a function of its `Context` that acts at once and returns None, or returns a job: an iterator that is
advanced once per cycle until it ends.
"""

import math
from collections import deque
from collections.abc import Callable, Generator

import numpy as np

from sim_backends.models.arm import ArmModel
from sim_backends.models.arm_kinematics import Matrix, Vector, invert, matrix_from_pose, pose_from_matrix
from sim_backends.models.arm_motion import (
    ForceMode,
    JointMove,
    JointSpeed,
    LinearMove,
    LinearSpeed,
    Servo,
    SimulatedMotion,
    StopMotion,
)
from sim_backends.peers.arm.rtde.variables import Registers

_KEEP, _, _HIGH, _HIGH_ONLY_WHILE_RUNNING = range(4)


class HeldOutputs:
    """What each output does while no program runs; such a setting outlives programs until it is changed. Source: the
    script manual, `set_runstate_standard_digital_output_to_value` and its like for the other outputs."""

    def __init__(self, model: ArmModel) -> None:
        self._model = model
        self._choices: dict[int, int] = {}

    def hold(self, running: bool) -> None:
        """One cycle: set what is to be set. A paused program does not run."""
        for index, choice in self._choices.items():
            if not running or choice == _HIGH_ONLY_WHILE_RUNNING:
                level = running or choice == _HIGH
                self._model.write_digital_outputs(1 << index, int(level) << index)

    def choose(self, index: int, choice: int) -> None:
        """What output `index` does while no program runs: 0 stays, 1 low, 2 high, 3 high only while one does. Raises
        ValueError for another choice."""
        if choice not in range(4):
            raise ValueError(f"a choice of {choice}, 0 to 3 are known")
        self._choices.pop(index, None)
        if choice != _KEEP:
            self._choices[index] = choice


Job = Generator[None, None, None]

CYCLE = 0.002
"""Seconds between two cycles of the controller."""
_HISTORY = 500


def done() -> Job:
    """A job that is done at once."""
    yield from ()


class ProgramError(Exception):
    """A run-time error of the program, which ends it; where in its script, from 1, or 0 where that is not known."""

    line = column = 0


class Context:
    """The variables of one program run on one arm; its registers begin at `offset`."""

    def __init__(self, model: ArmModel, registers: Registers, offset: int) -> None:
        self.model = model
        self.registers = registers
        self.offset = offset
        self.path: Callable[[], Job] = done
        """Follows the way points that the client has put into its script."""
        self.watchdog_period: float | None = None
        self.thread: str | None = None
        """Name of the streaming thread that holds the arm."""
        self.streamed = np.zeros(6)
        self.speed_is_linear = True
        self.stop_is_linear = False
        self.touched = 0
        self.contact_direction: Vector | None = None
        self.contact_steps = 0
        self.contact_seen = False
        self._recent: deque[Vector] = deque(maxlen=_HISTORY)
        self._background: Job | None = None
        self._operation = 0
        self._changes = 0

    def requested(self) -> int:
        """The command in the register."""
        return self.registers.int_in[self.offset]

    def double(self, index: int) -> float:
        """One input double register."""
        return float(self.doubles(index, 1)[0])

    def doubles(self, index: int, count: int = 6) -> Vector:
        """`count` input double registers; a value that is not finite is a run-time error."""
        first = self.offset + index
        values = np.array(self.registers.double_in[first : first + count])
        if not np.isfinite(values).all():
            raise ProgramError(f"input registers {first}…{first + count - 1} hold a value that is not finite")
        return values

    def integer(self, index: int) -> int:
        """One input integer register."""
        return self.registers.int_in[self.offset + index]

    def pose(self, index: int) -> Matrix:
        """Six input double registers as a pose (4, 4)."""
        return matrix_from_pose(self.doubles(index))

    def answer(self, values: Vector) -> None:
        """Put results into the output double registers."""
        self.registers.double_out[self.offset : self.offset + len(values)] = values.tolist()

    def answer_integer(self, value: int) -> None:
        """Put a result into output integer register 1."""
        self.registers.int_out[self.offset + 1] = value

    def signal(self, value: int) -> None:
        """Tell the client: 1 ready, 2 done."""
        self.registers.int_out[self.offset] = value

    def signal_async(self, value: int) -> None:
        """Show the progress of an asynchronous operation: 0 started, more than 0 progress, less than 0 finished."""
        self._changes = (self._changes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        word = self._changes << 16 | self._operation << 24
        if value >= 0:
            word |= min(value, 32767) | 1 << 15
        self.registers.int_out[self.offset + 2] = word

    def wait(self, motion: SimulatedMotion) -> Job:
        """Start `motion` and wait for its end."""
        self.model.start(motion)
        while not self.model.idle:
            yield

    def require_free(self) -> None:
        """A run-time error while a streaming thread holds the arm, as the controller has it."""
        if self.thread is not None:
            raise ProgramError(f"another thread is already controlling the robot ({self.thread}): stop it first")

    def take(self, thread: str) -> None:
        """Give the arm to a streaming thread; a run-time error while another one or a move holds it."""
        if self.thread == thread:
            return
        self.require_free()
        if self._background is not None:
            raise ProgramError("another thread is already controlling the robot (move): stop it first")
        self.thread = thread

    def sync_or_async(self, job: Job) -> Job | None:
        """The job itself, or None when the client asked for it to go on in the background."""
        if self.integer(1) != 1:
            return job
        self._background = job
        self.signal_async(0)
        next(job, None)
        return None

    def end_background(self) -> None:
        """Kill the asynchronous operation, if there is one."""
        if self._background is not None:
            self._background = None
            self.signal_async(-1)

    def advance_background(self) -> None:
        """Advance the asynchronous operation and note where the arm is."""
        self._recent.append(self.model.drive.q)
        if self._background is not None and next(self._background, True) is not None:
            self._background = None
            self.signal_async(-1)

    def joints_before(self, steps: int) -> Vector:
        """Joint angles `steps` cycles ago, as far back as they are known."""
        if not self._recent:
            return self.model.drive.q
        return self._recent[max(0, len(self._recent) - 1 - max(0, steps))]

    def forward(self, q: Vector) -> Matrix:
        """Tool pose (4, 4) at joint angles (6,)."""
        pose: Matrix = self.model.kinematics.forward(q).dot(self.model.drive.flange_from_tcp)
        return pose

    def solve(self, base_from_tcp: Matrix, near: Vector | None = None, tolerance: float = 1e-9) -> Vector:
        """Joint angles for a tool pose next to `near` (the present ones); a run-time error when there are none."""
        drive = self.model.drive
        flange = base_from_tcp.dot(invert(drive.flange_from_tcp))
        limit = self.model.params.joint_limit
        q = self.model.kinematics.inverse(flange, drive.q if near is None else near, limit, tolerance)
        if q is None:
            place = np.round(base_from_tcp[:3, 3], 4).tolist()
            raise ProgramError(f"get_inverse_kin: no solution for a tool at {place} m")
        return q

    def has_solution(self, near: Vector | None = None) -> bool:
        """Whether the pose in the first registers can be reached."""
        try:
            self.solve(self.pose(0), near)
        except ProgramError:
            return False
        return True


_CONTACT_FORCE = 10.0
"""Force in N along the direction of motion that counts as contact."""

# --- moves ---


def _move(c: Context, job: Job) -> Job | None:
    c.require_free()
    c.end_background()
    return c.sync_or_async(job)


def _move_joints(c: Context, target: Vector) -> Job | None:
    return _move(c, c.wait(JointMove(target, c.double(6), c.double(7))))


def _move_tool(c: Context, target: Matrix) -> Job | None:
    return _move(c, c.wait(LinearMove(target, c.double(6), c.double(7))))


def _stop_move(c: Context) -> Job | None:
    # Once an asynchronous stop was asked for, the script brakes linearly, whichever of the two commands comes.
    if c.integer(1) == 1:
        c.stop_is_linear = True
    return _move(c, c.wait(StopMotion(c.double(0), linear=c.stop_is_linear)))


# --- streams ---


def _servo(c: Context, target: Vector) -> None:
    # A smoother target (longer look-ahead) or a softer controller (smaller gain) is followed later.
    lag = max(c.model.params.tracking_lag, c.double(9) * 300.0 / max(c.double(10), 1.0))
    c.take("servo")
    motion = c.model.motion
    if isinstance(motion, Servo):
        motion.target, motion.lag = target, lag
    else:
        c.model.start(Servo(target, lag))


def _servo_c(c: Context) -> None:
    target = c.doubles(0)
    begun = c.thread == "servo"
    c.take("servo")
    if not begun or not np.array_equal(target, c.streamed):
        c.streamed = target
        c.model.start(LinearMove(matrix_from_pose(target), c.double(6), c.double(7)))


def _stop_stream(c: Context, deceleration: float, *, linear: bool = True) -> Job:
    c.thread = None
    return c.wait(StopMotion(deceleration, linear=linear))


def _speed_j(c: Context) -> None:
    c.speed_is_linear = False
    _speed(c, "speed", JointSpeed(c.doubles(0), c.double(6)))


def _speed_l(c: Context) -> None:
    c.speed_is_linear = True
    _speed(c, "speed", LinearSpeed(c.doubles(0), c.double(6)))


def _speed(c: Context, thread: str, wanted: JointSpeed | LinearSpeed) -> None:
    c.take(thread)
    motion = c.model.motion
    if type(motion) is type(wanted) and isinstance(motion, JointSpeed | LinearSpeed):
        motion.target, motion.acceleration = wanted.target, wanted.acceleration
    else:
        c.model.start(wanted)


def _jog_start(c: Context) -> None:
    speed, feature = c.doubles(0), round(c.double(6))
    turn = np.eye(3)
    if feature == 1:
        turn = c.model.drive.base_from_tcp()[:3, :3]
    elif feature == 2:
        turn = c.pose(8)[:3, :3]
    twist = np.concatenate((turn.dot(speed[:3]), turn.dot(speed[3:])))
    _speed(c, "jog", LinearSpeed(twist, c.double(7)))


# --- compliance and contact ---


def _force_mode(c: Context) -> None:
    """Compliance acts while no other motion does; it is not superposed on moves."""
    selection = np.array([float(c.integer(i)) for i in range(2, 8)])
    wanted = ForceMode(c.pose(0), selection, c.doubles(6), c.doubles(12))
    motion = c.model.motion
    if isinstance(motion, ForceMode):
        motion.task, motion.selection = wanted.task, wanted.selection
        motion.wrench, motion.limits = wanted.wrench, wanted.limits
    elif c.model.idle:
        c.model.start(wanted)


def tool_contact(c: Context, direction: Vector) -> int:
    """Cycles since the tool first felt the contact it now feels along `direction` (any if zero); 0 without."""
    force = c.model.felt[:3]
    length = math.hypot(*direction[:3])
    size = -float(force.dot(direction[:3])) / length if length > 0 else math.hypot(*force)
    c.touched = c.touched + 1 if size > 0.3 * _CONTACT_FORCE else 0
    return c.touched if size > _CONTACT_FORCE else 0


def _move_until_contact(c: Context) -> Job:
    c.require_free()
    direction = c.doubles(6)
    c.touched = 0
    c.model.start(LinearSpeed(c.doubles(0), c.double(12)))
    while not (steps := tool_contact(c, direction)):
        yield
    yield from _back_to(c, c.joints_before(steps))


def _back_to(c: Context, q: Vector) -> Job:
    yield from c.wait(StopMotion(3.0, linear=True))
    yield from c.wait(LinearMove(c.forward(q), 0.25, 1.2))


def _start_contact_detection(c: Context) -> None:
    c.touched = c.contact_steps = 0
    c.contact_direction = c.doubles(0)


def _stop_contact_detection(c: Context) -> None:
    c.contact_direction = None
    c.answer_integer(c.contact_steps)


def _contact_detected(c: Context) -> Job:
    c.end_background()
    return _back_to(c, c.joints_before(c.contact_steps))


def _inverse_near(c: Context) -> None:
    tolerance = min(max(c.double(12), 1e-12), 1e-3)
    c.answer(c.solve(c.pose(0), c.doubles(6), tolerance))


def _forward_of(c: Context) -> None:
    # A request without a tool offset leaves another command's numbers in its registers: it means no offset.
    given = f"input_double_register_{c.offset + 6}" in c.registers.command_fields
    tool = c.pose(6) if given else np.eye(4)
    c.answer(pose_from_matrix(c.model.kinematics.forward(c.doubles(0)).dot(tool)))


def _forward_now(c: Context) -> None:
    c.answer(pose_from_matrix(c.model.drive.base_from_tcp()))


def _set_payload(c: Context) -> None:
    centre = c.doubles(1, 3)
    c.model.payload = (c.double(0), centre if centre.any() else c.model.payload[1])


def _set_tcp(c: Context) -> None:
    c.model.drive.flange_from_tcp = c.pose(0)


def _set_watchdog(c: Context) -> None:
    frequency = c.double(0)
    c.watchdog_period = 1.0 / frequency if frequency > 0 else None


def _joints_within_limits(c: Context) -> None:
    c.answer_integer(int(bool((np.abs(c.doubles(0)) <= c.model.params.joint_limit).all())))


def _joint_torques(c: Context) -> None:
    c.answer(c.model.drive.tcp_jacobian().T.dot(c.model.felt))


COMMANDS: dict[int, Callable[[Context], Job | None]] = {
    1: lambda c: _move_joints(c, c.doubles(0)), 2: lambda c: _move_joints(c, c.solve(c.pose(0))),
    3: lambda c: _move_tool(c, c.pose(0)), 4: lambda c: _move_tool(c, c.forward(c.doubles(0))), 6: _force_mode,
    7: lambda c: c.wait(StopMotion(10.0, linear=True)), 8: lambda c: c.model.zero_force(), 9: _speed_j, 10: _speed_l,
    11: lambda c: _servo(c, c.doubles(0)), 12: _servo_c,
    15: lambda c: _stop_stream(c, c.double(0), linear=c.speed_is_linear), 16: lambda c: _stop_stream(c, c.double(0)),
    17: _set_payload, 24: lambda c: _servo(c, c.solve(c.pose(0))),
    25: lambda c: c.answer_integer(tool_contact(c, c.doubles(0))), 26: lambda c: c.answer(np.array([CYCLE])),
    27: lambda c: c.answer(c.joints_before(c.integer(1))), 28: _forward_now, 29: _set_tcp, 30: _inverse_near,
    31: lambda c: c.model.protective_stop("triggered by the program"), 33: _stop_move, 34: _stop_move,
    35: _set_watchdog, 36: lambda c: c.answer_integer(int(c.has_solution())), 37: _joints_within_limits,
    38: _joint_torques, 39: lambda c: c.answer(pose_from_matrix(c.pose(0).dot(c.pose(6)))),
    40: lambda c: c.answer(pose_from_matrix(c.model.drive.flange_from_tcp)), 41: _jog_start,
    42: lambda c: _stop_stream(c, 1.2), 43: _forward_now, 44: _forward_of, 45: lambda c: _move(c, c.path()),
    46: lambda c: c.answer(c.solve(c.pose(0))),
    47: lambda c: c.answer_integer(int(c.model.steady)), 51: _move_until_contact, 54: lambda c: c.answer_integer(0),
    58: lambda c: c.answer(pose_from_matrix(c.model.reported_flange())),
    60: lambda c: c.answer_integer(int(c.has_solution())),
    61: lambda c: c.answer_integer(int(c.has_solution(c.doubles(6)))), 62: _start_contact_detection,
    63: _stop_contact_detection, 64: lambda c: c.answer_integer(c.contact_steps), 65: _set_payload,
    254: _contact_detected,
}  # fmt: skip
"""Command number → action; other numbers are answered as done. Settings of teaching, damping and external sensors have
no effect on the simulated arm."""
