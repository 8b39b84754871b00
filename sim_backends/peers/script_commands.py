"""What the commands of ur_rtde's control script do on the simulated arm, by command number (protocol sheet, section 1).

A command either acts at once and returns None, or returns a job that is advanced once per cycle until it ends.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from sim_backends.models.arm import ArmModel
from sim_backends.models.arm_kinematics import Matrix, Vector, matrix_from_pose, pose_from_matrix
from sim_backends.models.arm_motion import (
    ForceMode,
    JointMove,
    JointSpeed,
    LinearMove,
    LinearSpeed,
    Motion,
    Servo,
    Stop,
)
from sim_backends.peers.rtde_registers import Registers

Job = Iterator[None]

IMMEDIATE = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
"""Commands that are carried out in every cycle while they stand in the register."""
STOP_SCRIPT = 255

_CYCLE = 0.002
_CONTACT_FORCE = 10.0
_STATEMENT = re.compile(r"^\s*(\w+)\((.*)\)\s*$")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


class ProgramError(Exception):
    """A run-time error of the program, which ends it."""


class Commands:
    """The commands of one program run, with the program's variables."""

    def __init__(self, model: ArmModel, registers: Registers, offset: int, text: str) -> None:
        self.watchdog_period: float | None = None
        self._model = model
        self._registers = registers
        self._offset = offset
        self._path = _path_statements(text)
        self._background: Job | None = None
        self._background_moves = False
        self._thread: str | None = None
        self._target = np.zeros(6)
        self._speed_is_linear = True
        self._stop_is_linear = False
        self._operation = 0
        self._changes = 0
        self._recent: deque[Vector] = deque(maxlen=500)
        self._touched = 0
        self._contact_direction: Vector | None = None
        self._contact_steps = 0
        self._contact_seen = False

    # --- registers and signals ---

    def requested(self) -> int:
        """The command in the register; while it is 0, one the program gives itself."""
        command = self._registers.int_in[self._offset]
        if command == 0 and self._contact_seen:
            self._contact_seen = False
            return 254
        return command

    def signal(self, value: int) -> None:
        """Tell the client: 1 ready, 2 done."""
        self._registers.int_out[self._offset] = value

    def signal_async(self, value: int) -> None:
        """Show the progress of an asynchronous operation: 0 started, more than 0 progress, less than 0 finished."""
        self._changes = (self._changes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        word = self._changes << 16 | self._operation << 24
        if value >= 0:
            word |= min(value, 32767) | 1 << 15
        self._registers.int_out[self._offset + 2] = word

    def process(self, command: int) -> Job | None:
        """Carry out a command; unknown ones do nothing and count as done."""
        action = self._ACTIONS.get(command)
        return action(self) if action is not None else None

    def advance_background(self) -> None:
        """Advance what runs beside the command loop: an asynchronous move or stop, and contact detection."""
        self._recent.append(self._model.drive.q)
        if self._background is not None and next(self._background, True) is not None:
            self._background = None
            self.signal_async(-1)
        if self._contact_direction is not None:
            steps = self._tool_contact(self._contact_direction)
            if steps:
                self._contact_direction = None
                self._contact_steps = steps
                self._contact_seen = True

    def end_background(self) -> None:
        """Kill an asynchronous operation."""
        if self._background is not None:
            self._background = None
            self.signal_async(-1)

    def run_text(self, text: str) -> Job:
        """Carry out the statements of an uploaded program other than the control script."""
        for line in text.splitlines():
            if not line.strip() or line.startswith(("def ", "sec ", "end")) or line.lstrip().startswith("#"):
                continue
            yield from self._statement(line)

    def _double(self, index: int) -> float:
        return float(self._doubles(index, 1)[0])

    def _doubles(self, index: int, count: int = 6) -> Vector:
        first = self._offset + index
        values = np.array(self._registers.double_in[first : first + count])
        if not np.isfinite(values).all():
            raise ProgramError(f"input registers {first}…{first + count - 1} hold a value that is not finite")
        return values

    def _int(self, index: int) -> int:
        return self._registers.int_in[self._offset + index]

    def _pose(self, index: int) -> Matrix:
        return matrix_from_pose(self._doubles(index))

    def _answer(self, values: Vector) -> None:
        self._registers.double_out[self._offset : self._offset + len(values)] = values.tolist()

    def _answer_int(self, value: int) -> None:
        self._registers.int_out[self._offset + 1] = value

    # --- motion ---

    def _wait(self, motion: Motion) -> Job:
        self._model.start(motion)
        while not self._model.idle:
            yield

    def _require_free(self) -> None:
        if self._thread is not None:
            raise ProgramError(f"another thread is already controlling the robot ({self._thread}): stop it first")

    def _move(self, motion: Motion) -> Job | None:
        self._require_free()
        self.end_background()
        return self._sync_or_async(self._wait(motion))

    def _sync_or_async(self, job: Job) -> Job | None:
        if self._int(1) != 1:
            return job
        self._background = job
        self._background_moves = True
        self.signal_async(0)
        next(job, None)
        return None

    def _move_j(self) -> Job | None:
        self._target = self._model.drive.q
        return self._move(JointMove(self._doubles(0), self._double(6), self._double(7)))

    def _move_j_ik(self) -> Job | None:
        return self._move(JointMove(self._solve(self._pose(0)), self._double(6), self._double(7)))

    def _move_l(self) -> Job | None:
        return self._move(LinearMove(self._pose(0), self._double(6), self._double(7)))

    def _move_l_fk(self) -> Job | None:
        return self._move(LinearMove(self._forward(self._doubles(0)), self._double(6), self._double(7)))

    def _move_path(self) -> Job | None:
        self._require_free()
        self.end_background()
        return self._sync_or_async(self._follow_path())

    def _follow_path(self) -> Job:
        for line in self._path:
            yield from self._statement(line)

    def _statement(self, line: str) -> Job:
        """One script statement. Blend radii are not modelled: the arm stops at every way point."""
        match = _STATEMENT.match(line)
        name = match[1] if match else line.strip()
        numbers = [float(n) for n in re.findall(_NUMBER, match[2])] if match else []
        if match and name in ("movej", "movel", "movep") and len(numbers) >= 6:
            options = {k: float(v) for k, v in re.findall(rf"\b([avr])\s*=\s*({_NUMBER})", match[2])}
            pose_given = match[2].lstrip().startswith("p")
            joints = np.array(numbers[:6])
            if name == "movej":
                target = self._solve(matrix_from_pose(joints)) if pose_given else joints
                yield from self._wait(JointMove(target, options.get("v", 1.05), options.get("a", 1.4)))
            else:
                goal = matrix_from_pose(joints) if pose_given else self._forward(joints)
                yield from self._wait(LinearMove(goal, options.get("v", 0.25), options.get("a", 1.2)))
        elif name in ("stopj", "stopl") and numbers:
            yield from self._wait(Stop(numbers[0], linear=name == "stopl"))
        elif name == "signal_async_progress" and numbers:
            self.signal_async(int(numbers[0]))
        elif name == "write_output_integer_register" and len(numbers) >= 2:
            self._registers.int_out[int(sum(numbers[:-1])) % 48] = int(numbers[-1])
        elif match and name in ("set_digital_out", "set_standard_digital_out") and numbers:
            bit = 1 << int(numbers[0])
            self._model.write_digital_outputs(bit, bit if "True" in match[2] else 0)
        elif name != "textmsg":
            raise ProgramError(f"cannot run the statement {line.strip()[:60]!r}")

    def _stop_move(self) -> Job | None:
        rate = self._double(0)
        self._require_free()
        self.end_background()
        if self._int(1) == 1:
            self._stop_is_linear = True
        return self._sync_or_async(self._wait(Stop(rate, linear=self._stop_is_linear)))

    # --- streamed motion ---

    def _stream(self, thread: str) -> bool:
        """Take control for a streaming thread; True when it controlled the arm already."""
        if self._thread == thread:
            return not self._model.idle
        self._require_free()
        if self._background is not None:
            raise ProgramError("another thread is already controlling the robot (move): stop it first")
        self._thread = thread
        return False

    def _servo_j(self) -> None:
        self._servo(self._doubles(0))

    def _servo_l(self) -> None:
        self._servo(self._solve(self._pose(0)))

    def _servo(self, target: Vector) -> None:
        lookahead, gain = self._double(9), self._double(10)
        # A smoother target (longer look-ahead) or a softer controller (smaller gain) follows later.
        lag = max(self._model.params.tracking_lag, lookahead * 300.0 / max(gain, 1.0))
        self._stream("servo")
        motion = self._model.motion
        if isinstance(motion, Servo):
            motion.target, motion.lag = target, lag
        else:
            self._model.start(Servo(target, lag))

    def _servo_c(self) -> None:
        target = self._doubles(0)
        if not self._stream("servo") or not np.array_equal(target, self._target):
            self._target = target
            self._model.start(LinearMove(matrix_from_pose(target), self._double(6), self._double(7)))

    def _servo_stop(self) -> Job:
        self._thread = None
        return self._wait(Stop(self._double(0), linear=True))

    def _speed_j(self) -> None:
        self._speed_is_linear = False
        self._stream("speed")
        self._run_speed(JointSpeed(self._doubles(0), self._double(6)))

    def _speed_l(self) -> None:
        self._speed_is_linear = True
        self._stream("speed")
        self._run_speed(LinearSpeed(self._doubles(0), self._double(6)))

    def _run_speed(self, wanted: JointSpeed | LinearSpeed) -> None:
        motion = self._model.motion
        if type(motion) is type(wanted) and isinstance(motion, JointSpeed | LinearSpeed):
            motion.target, motion.acceleration = wanted.target, wanted.acceleration
        else:
            self._model.start(wanted)

    def _speed_stop(self) -> Job:
        self._thread = None
        return self._wait(Stop(self._double(0), linear=self._speed_is_linear))

    def _jog_start(self) -> None:
        speed = self._doubles(0)
        feature = round(self._double(6))
        turn = np.eye(3)
        if feature == 1:
            turn = self._model.drive.base_from_tcp()[:3, :3]
        elif feature == 2:
            turn = self._pose(8)[:3, :3]
        self._stream("jog")
        twist = np.concatenate((turn.dot(speed[:3]), turn.dot(speed[3:])))
        self._run_speed(LinearSpeed(twist, self._double(7)))

    def _jog_stop(self) -> Job:
        self._thread = None
        return self._wait(Stop(1.2, linear=True))

    def _force_mode(self) -> None:
        """Compliance replaces other motions while it is active; it is not superposed on them."""
        selection = np.array([float(self._int(i)) for i in range(2, 8)])
        wanted = ForceMode(self._pose(0), selection, self._doubles(6), self._doubles(12))
        motion = self._model.motion
        if isinstance(motion, ForceMode):
            motion.task, motion.selection = wanted.task, wanted.selection
            motion.wrench, motion.limits = wanted.wrench, wanted.limits
        elif self._model.idle:
            self._model.start(wanted)

    def _force_stop(self) -> Job:
        return self._wait(Stop(10.0, linear=True))

    # --- contact ---

    def _tool_contact(self, direction: Vector) -> int:
        """Cycles since the tool first felt the contact it now feels along `direction` (any if zero); 0 without."""
        force = self._model.felt[:3]
        length = math.hypot(*direction[:3])
        size = -float(force.dot(direction[:3])) / length if length > 0 else math.hypot(*force)
        self._touched = min(self._touched + 1, 499) if size > 0.3 * _CONTACT_FORCE else 0
        return self._touched if size > _CONTACT_FORCE else 0

    def _joints_before(self, steps: int) -> Vector:
        return self._recent[max(0, len(self._recent) - 1 - steps)] if self._recent else self._model.drive.q

    def _move_until_contact(self) -> Job:
        self._require_free()
        direction = self._doubles(6)
        self._touched = 0
        self._model.start(LinearSpeed(self._doubles(0), self._double(12)))
        while not (steps := self._tool_contact(direction)):
            yield
        yield from self._back_to(self._joints_before(steps))

    def _back_to(self, q: Vector) -> Job:
        yield from self._wait(Stop(3.0, linear=True))
        yield from self._wait(LinearMove(self._forward(q), 0.25, 1.2))

    def _contact_detected(self) -> Job:
        self.end_background()
        return self._back_to(self._joints_before(self._contact_steps))

    def _start_contact_detection(self) -> None:
        self._touched = 0
        self._contact_steps = 0
        self._contact_direction = self._doubles(0)

    def _stop_contact_detection(self) -> None:
        self._contact_direction = None
        self._answer_int(self._contact_steps)

    # --- kinematics and settings ---

    def _forward(self, q: Vector) -> Matrix:
        pose: Matrix = self._model.kinematics.forward(q).dot(self._model.drive.flange_from_tcp)
        return pose

    def _solve(self, base_from_tcp: Matrix, near: Vector | None = None, tolerance: float = 1e-9) -> Vector:
        drive = self._model.drive
        flange = base_from_tcp.dot(np.linalg.inv(drive.flange_from_tcp))
        limit = self._model.params.joint_limit
        q = self._model.kinematics.inverse(flange, drive.q if near is None else near, limit, tolerance)
        if q is None:
            place = np.round(base_from_tcp[:3, 3], 4).tolist()
            raise ProgramError(f"get_inverse_kin: no solution for a tool at {place} m")
        return q

    def _has_solution(self, near: Vector | None = None) -> bool:
        try:
            self._solve(self._pose(0), near)
        except ProgramError:
            return False
        return True

    def _inverse_near(self) -> None:
        tolerance = min(max(self._double(12), 1e-12), 1e-3)
        self._answer(self._solve(self._pose(0), self._doubles(6), tolerance))

    def _forward_of(self) -> None:
        # A request without a tool offset leaves another command's numbers in its registers: it means no offset.
        given = f"input_double_register_{self._offset + 6}" in self._registers.command_fields
        tool = self._pose(6) if given else np.eye(4)
        self._answer(pose_from_matrix(self._model.kinematics.forward(self._doubles(0)).dot(tool)))

    def _set_payload(self) -> None:
        mass, centre = self._double(0), self._doubles(1, 3)
        self._model.payload = (mass, centre if centre.any() else self._model.payload[1])

    def _set_tcp(self) -> None:
        self._model.drive.flange_from_tcp = self._pose(0)

    def _set_watchdog(self) -> None:
        frequency = self._double(0)
        self.watchdog_period = 1.0 / frequency if frequency > 0 else None

    def _within_limits(self) -> None:
        self._answer_int(int(bool((np.abs(self._doubles(0)) <= self._model.params.joint_limit).all())))

    def _joint_torques(self) -> None:
        self._answer(self._model.drive.tcp_jacobian().T.dot(self._model.felt))

    _ACTIONS: dict[int, Callable[[Commands], Job | None]] = {  # noqa: RUF012
        1: _move_j,
        2: _move_j_ik,
        3: _move_l,
        4: _move_l_fk,
        6: _force_mode,
        7: _force_stop,
        8: lambda c: c._model.zero_force(),
        9: _speed_j,
        10: _speed_l,
        11: _servo_j,
        12: _servo_c,
        15: _speed_stop,
        16: _servo_stop,
        17: _set_payload,
        24: _servo_l,
        25: lambda c: c._answer_int(c._tool_contact(c._doubles(0))),
        26: lambda c: c._answer(np.array([_CYCLE])),
        27: lambda c: c._answer(c._joints_before(c._int(1))),
        28: lambda c: c._answer(pose_from_matrix(c._model.drive.base_from_tcp())),
        29: _set_tcp,
        30: _inverse_near,
        31: lambda c: c._model.protective_stop("triggered by the program"),
        33: _stop_move,
        34: _stop_move,
        35: _set_watchdog,
        36: lambda c: c._answer_int(int(c._has_solution())),
        37: _within_limits,
        38: _joint_torques,
        39: lambda c: c._answer(pose_from_matrix(c._pose(0).dot(c._pose(6)))),
        40: lambda c: c._answer(pose_from_matrix(c._model.drive.flange_from_tcp)),
        41: _jog_start,
        42: _jog_stop,
        43: lambda c: c._answer(pose_from_matrix(c._model.drive.base_from_tcp())),
        44: _forward_of,
        45: _move_path,
        46: lambda c: c._answer(c._solve(c._pose(0))),
        47: lambda c: c._answer_int(int(c._model.steady)),
        51: _move_until_contact,
        54: lambda c: c._answer_int(0),
        58: lambda c: c._answer(pose_from_matrix(c._model.reported_flange())),
        60: lambda c: c._answer_int(int(c._has_solution())),
        61: lambda c: c._answer_int(int(c._has_solution(c._doubles(6)))),
        62: _start_contact_detection,
        63: _stop_contact_detection,
        64: lambda c: c._answer_int(c._contact_steps),
        65: _set_payload,
        254: _contact_detected,
    }


def _path_statements(text: str) -> list[str]:
    """The statements that a client has put into the control script's `exec_move_path`."""
    match = re.search(r"def exec_move_path\(\):\n(.*?)\n\s*end\b", text, re.DOTALL)
    lines = match[1].splitlines() if match else []
    return [line for line in lines if line.strip() and not line.lstrip().startswith(("#", "textmsg"))]
