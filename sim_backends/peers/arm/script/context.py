"""What the commands of the control script share: registers, signals to the client, and who moves the arm.

A command is a function of this context that acts at once and returns None, or returns a job: an iterator that is
advanced once per cycle until it ends.

Digital outputs that the controller sets by itself while no program runs.

Source: the script manual, `set_runstate_standard_digital_output_to_value` and its like for the other outputs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator

import numpy as np

from sim_backends.models.arm import ArmModel
from sim_backends.models.arm_kinematics import Matrix, Vector, invert, matrix_from_pose
from sim_backends.models.arm_motion import SimulatedMotion
from sim_backends.peers.arm.rtde.variables import Registers

_KEEP, _, _HIGH, _HIGH_ONLY_WHILE_RUNNING = range(4)


class HeldOutputs:
    """What each output does while no program runs; such a setting outlives programs until it is changed."""

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
        """What output `index` does while no program runs: 0 stays, 1 low, 2 high, 3 high only while one does.

        Raises ValueError for another choice.
        """
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

    # --- registers and signals ---

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

    # --- who moves the arm ---

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

    # --- kinematics of the tool ---

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
