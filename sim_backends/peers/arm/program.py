"""What runs on the controller: script texts as they are uploaded, and the program that serves commands in registers.

The program follows ur_rtde's control script (MIT, version 1.6): the command in input register 0, progress and results
in the output registers. This is the loop around the commands.
"""

import logging
import re
from collections import deque
from enum import IntEnum
from typing import NamedTuple

from sim_backends.models.arm import ArmModel, Safety
from sim_backends.peers.arm.commands import COMMANDS, CYCLE, Context, HeldOutputs, Job, ProgramError, done, tool_contact
from sim_backends.peers.arm.rtde.variables import Registers
from sim_backends.peers.arm.urscript.environment import Environment
from sim_backends.peers.arm.urscript.machine import Machine
from sim_backends.peers.arm.urscript.translate import ScriptError

IMMEDIATE = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
"""Commands that are carried out in every cycle while they stand in the register."""
_STOP_SCRIPT, _CONTACT_DETECTED = 255, 254

_log = logging.getLogger(__name__)
_RESUMING_CYCLES = 50


class Announcement(NamedTuple):
    """What the clients of the primary port are told: text, popup, started, stopped or failed, and its words. What
    failed has a place in its script, from 1; 0 where none is known."""

    kind: str
    words: str
    line: int = 0
    column: int = 0


_MOST_ANNOUNCED = 200
_OFFSET = re.compile(r"reg_offset_int\s*=\s*#[^\n]*\n?\s*(\d+)")
_NAME = re.compile(r"def\s+(\w+)")
_PATH = re.compile(r"def exec_move_path\(\):\n.*?\n\s*end\b", re.DOTALL)
"""Where ur_rtde puts a path of way points into its script."""


class RuntimeState(IntEnum):
    """State of the program, with the controller's numbers."""

    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class ProgramMemory:
    """The controller's program memory: at most one program, and what its outputs do while none runs."""

    def __init__(self, model: ArmModel, registers: Registers) -> None:
        self.runtime_state = RuntimeState.STOPPED
        self.message = ""
        self._model = model
        self._registers = registers
        self._context = Context(model, registers, 0)
        self._outputs = HeldOutputs(model)
        self._resumes_at = 0
        self._by_safeguard = False
        self._cycles = 0
        self._commands, self._commanded_at = 0, 0
        self._job: Job | None = None
        self._environment = Environment(self._outputs, self._announce, self.pause)
        self._serves_commands = False
        self._executing = False
        self._name = ""
        self.announcements: deque[Announcement] = deque(maxlen=_MOST_ANNOUNCED)

    def load(self, text: str) -> bool:
        """Run `text` in place of any other program; a secondary program (`sec`) runs at once, beside it.

        Whether a program was begun.

        Like on the controller, nothing changes while the arm cannot move or when the text does not compile.
        """
        if text.lstrip().startswith("sec "):
            self._run_secondary(text)
            return False
        found = _OFFSET.search(text)
        if not self._model.ready:
            self._note("a script was not started: the arm is not ready")
            return False
        context = Context(self._model, self._registers, int(found[1]) if found else 0)
        environment = Environment(self._outputs, self._announce, self.pause)
        try:
            machine = None if found else Machine(text, context, environment)
            if path := _PATH.search(text) if found else None:
                context.path = Machine(path[0], context, environment).run
        except ScriptError as error:
            self._note(f"a script was not started: compile error in {text.strip()[:60]!r}: {error}")
            self._announce("failed", error.told, error.line, error.column)
            return False
        self.stop("another program was started")
        self._model.halt()
        self._serves_commands = machine is None
        self._executing = False
        self._context, self._environment = context, environment
        self._job = None if machine is None else machine.run()
        self.runtime_state = RuntimeState.PLAYING
        self._commanded_at = self._cycles
        self.message = ""
        name = _NAME.search(text)
        self._name = name[1] if name else "unnamed"
        self._announce("started", self._name)
        if self._serves_commands:
            self._context.signal_async(-1)
        return True

    def _run_secondary(self, text: str) -> None:
        """A secondary program runs at once, beside the main one; it may only do what takes no time."""
        environment = Environment(self._outputs, self._announce, self.pause)
        try:
            Machine(text, Context(self._model, self._registers, 0), environment).run_at_once()
        except (ScriptError, ProgramError) as error:
            told = error.told if isinstance(error, ScriptError) else str(error)
            self._note(f"a secondary program failed: {error}")
            self._announce("failed", told, error.line, error.column)

    def close_popup(self) -> None:
        """Let a program go on that waits for a person to close its message."""
        self._environment.popup_open = False

    def play(self) -> bool:
        """Continue a paused program, a moment from now; False when there is none or the arm is not ready."""
        if self.runtime_state is not RuntimeState.PAUSED or not self._model.ready:
            return False
        self.runtime_state = RuntimeState.RESUMING
        self._resumes_at = self._cycles + _RESUMING_CYCLES
        return True

    def pause(self) -> bool:
        """Pause a playing program and its motion, which ends at rest; False when none plays."""
        if self.runtime_state not in (RuntimeState.PLAYING, RuntimeState.RESUMING):
            return False
        self._model.suspend()
        self.runtime_state = RuntimeState.PAUSING
        return True

    def stop(self, reason: str) -> None:
        """End the program and brake the arm; idempotent."""
        if self.runtime_state is RuntimeState.STOPPED:
            return
        self.runtime_state = RuntimeState.STOPPED
        if self._job is not None:
            self._job.close()
        self._job = None
        self._context.end_background()
        self._model.halt()
        self._note(f"program stopped: {reason}")
        self._announce("stopped", self._name)

    def tick(self, held_up: bool = False) -> None:
        """One cycle of the controller: follow the safety system, then the program.

        `held_up` says that this cycle is made up for: the host did not let the controller run in time, and perhaps its
        clients neither. Such a cycle does not count as silence, since a real controller runs in real time.
        """
        self._cycles += not held_up
        self._environment.held_up = held_up
        self._follow_safety()
        self._change_over()
        if self.runtime_state is RuntimeState.PLAYING:
            try:
                self._cycle()
            except ProgramError as error:
                self._announce("failed", str(error), error.line, error.column)
                self.stop(str(error))
        self._outputs.hold(self.runtime_state is RuntimeState.PLAYING)

    def _follow_safety(self) -> None:
        if self.runtime_state is RuntimeState.STOPPED or self._model.ready:
            return
        safety = self._model.safety
        if safety not in (Safety.PROTECTIVE_STOP, Safety.SAFEGUARD_STOP):
            self.stop(self._model.fault_text or "the arm was switched off")
        elif self.runtime_state in (RuntimeState.PLAYING, RuntimeState.RESUMING):
            self.runtime_state = RuntimeState.PAUSING
            self._by_safeguard = safety is Safety.SAFEGUARD_STOP

    def _change_over(self) -> None:
        """From pausing to paused once the arm stands, from resuming to playing; a closed safeguard resumes."""
        if self.runtime_state is RuntimeState.PAUSING and not self._model.moving:
            self.runtime_state = RuntimeState.PAUSED
        elif self.runtime_state is RuntimeState.PAUSED and self._by_safeguard and self.play():
            self._by_safeguard = False
        elif self.runtime_state is RuntimeState.RESUMING and self._cycles >= self._resumes_at:
            self._model.resume()
            self.runtime_state = RuntimeState.PLAYING
            self._commanded_at = self._cycles

    def _cycle(self) -> None:
        self._check_watchdog()
        self._context.advance_background()
        self._watch_contact()
        if self._job is not None:
            self._continue(self._job)
            return
        command = self._next_command()
        if command in IMMEDIATE:
            self._process(command)
            self._context.signal(1)
        elif command == 0:
            self._executing = False
            self._context.signal(1)
        elif not self._executing:
            self._executing = True
            if command == _STOP_SCRIPT:
                self.stop("ended by its client")
                return
            job = self._process(command)
            self._continue(done() if job is None else job)

    def _next_command(self) -> int:
        """The client's command; while there is none, one that the program gives itself."""
        command = self._context.requested()
        if command == 0 and self._context.contact_seen:
            self._context.contact_seen = False
            return _CONTACT_DETECTED
        return command

    def _process(self, command: int) -> Job | None:
        action = COMMANDS.get(command)
        return None if action is None else action(self._context)

    def _continue(self, job: Job) -> None:
        """Advance a job that takes several cycles; tell the client once it is done."""
        self._job = job
        if next(job, True) is None:
            return
        self._job = None
        if self._serves_commands:
            self._context.signal(2)
        else:
            self.stop("ended")

    def _watch_contact(self) -> None:
        context = self._context
        if context.contact_direction is None:
            return
        steps = tool_contact(context, context.contact_direction)
        if steps:
            context.contact_direction = None
            context.contact_steps = steps
            context.contact_seen = True

    def _check_watchdog(self) -> None:
        """Cycles are counted, which are on the wall's time however fast the world runs."""
        if self._commands != self._registers.commands:
            self._commands, self._commanded_at = self._registers.commands, self._cycles
        limit = self._context.watchdog_period
        silence = CYCLE * (self._cycles - self._commanded_at)
        if limit is not None and silence > limit:
            raise ProgramError(f"watchdog: no input for {silence:.3f} s, at most {limit:.3f} s allowed")

    def _announce(self, kind: str, words: str, line: int = 0, column: int = 0) -> None:
        self.announcements.append(Announcement(kind, words, line, column))

    def _note(self, message: str) -> None:
        self.message = message
        _log.info("%s", message)
