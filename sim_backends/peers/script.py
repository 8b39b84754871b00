"""What runs on the controller: script texts as they are uploaded, and the program that serves commands in registers.

The program follows ur_rtde's control script (MIT, version 1.6): the command in input register 0, progress and results
in the output registers. What each command does is in `script_commands`; this module is the loop around them.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from enum import IntEnum

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, Safety
from sim_backends.peers.rtde_registers import Registers
from sim_backends.peers.script_commands import IMMEDIATE, STOP_SCRIPT, Commands, Job, ProgramError

_log = logging.getLogger(__name__)
_TEXT_LIMIT = 1 << 20
_OFFSET = re.compile(r"reg_offset_int\s*=\s*#[^\n]*\n?\s*(\d+)")


class RuntimeState(IntEnum):
    """State of the program, with the controller's numbers."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class ScriptText:
    """Collects the bytes of one script connection into complete programs and single-line commands."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> list[str]:
        """Texts completed by `data`: a `def` runs to its `end` in column 0, anything else to the end of its line."""
        self._buffer += data
        texts = []
        while self._buffer:
            stripped = self._buffer.lstrip()
            is_program = stripped.startswith((b"def ", b"sec "))
            end = self._buffer.find(b"\nend\n") + 5 if is_program else self._buffer.find(b"\n") + 1
            if end <= (4 if is_program else 0):
                break
            text, self._buffer = self._buffer[:end], self._buffer[end:]
            if text.strip():
                texts.append(text.decode("utf-8", "replace"))
        if len(self._buffer) > _TEXT_LIMIT:
            self._buffer = b""
        return texts


class ControlProgram:
    """The controller's program memory: at most one program, playing, paused or stopped."""

    def __init__(self, model: ArmModel, registers: Registers, clock: WorldClock) -> None:
        self.runtime_state = RuntimeState.STOPPED
        self.message = ""
        self._model = model
        self._registers = registers
        self._clock = clock
        self._commands = Commands(model, registers, 0, "")
        self._job: Job | None = None
        self._serves_commands = False
        self._executing = False

    def load(self, text: str) -> None:
        """Run `text` in place of any other program; ignored, like on the controller, while the arm cannot move."""
        if not self._model.ready:
            self.message = "a script was not started: the arm is not ready"
            _log.info("%s", self.message)
            return
        if not text.lstrip().startswith(("def ", "sec ")) and self.runtime_state is RuntimeState.PLAYING:
            self.stop("replaced by a single command")
        self._model.halt()
        found = _OFFSET.search(text)
        self._serves_commands = found is not None
        self._commands = Commands(self._model, self._registers, int(found[1]) if found else 0, text)
        self._executing = False
        self._job = None if self._serves_commands else self._commands.run_text(text)
        self.runtime_state = RuntimeState.PLAYING
        self.message = ""
        if self._serves_commands:
            self._commands.signal_async(-1)

    def play(self) -> bool:
        """Continue a paused program; False when there is none or the arm is not ready."""
        if self.runtime_state is not RuntimeState.PAUSED or not self._model.ready:
            return False
        self._model.resume()
        self.runtime_state = RuntimeState.PLAYING
        return True

    def pause(self) -> bool:
        """Pause a playing program and its motion; False when none plays."""
        if self.runtime_state is not RuntimeState.PLAYING:
            return False
        self._model.suspend()
        self.runtime_state = RuntimeState.PAUSED
        return True

    def stop(self, reason: str) -> None:
        """End the program and brake the arm; idempotent."""
        if self.runtime_state is RuntimeState.STOPPED:
            return
        self.runtime_state = RuntimeState.STOPPED
        self.message = reason
        self._job = None
        self._commands.end_background()
        self._model.halt()
        _log.info("program stopped: %s", reason)

    def tick(self) -> None:
        """One cycle of the controller: follow the safety system, then the program."""
        if self.runtime_state is not RuntimeState.STOPPED and not self._model.ready:
            if self._model.safety is Safety.PROTECTIVE_STOP:
                self.runtime_state = RuntimeState.PAUSED
            else:
                self.stop(self._model.fault_text or "the arm was switched off")
        if self.runtime_state is not RuntimeState.PLAYING:
            return
        try:
            self._cycle()
        except ProgramError as error:
            self.stop(str(error))

    def _cycle(self) -> None:
        commands = self._commands
        self._check_watchdog()
        commands.advance_background()
        if self._job is not None:
            self._continue(self._job)
            return
        command = commands.requested()
        if command in IMMEDIATE:
            commands.process(command)
            commands.signal(1)
        elif command == 0:
            self._executing = False
            commands.signal(1)
        elif not self._executing:
            self._executing = True
            if command == STOP_SCRIPT:
                self.stop("ended by its client")
                return
            job = commands.process(command)
            self._continue(job if job is not None else iter(()))

    def _continue(self, job: Iterator[None]) -> None:
        """Advance a job that takes several cycles; tell the client once it is done."""
        self._job = job
        if next(job, True) is None:
            return
        self._job = None
        if self._serves_commands:
            self._commands.signal(2)
        else:
            self.stop("ended")

    def _check_watchdog(self) -> None:
        limit = self._commands.watchdog_period
        if limit is None:
            return
        silence = self._clock.wall(self._model.time) - self._registers.commanded_at
        if silence > limit:
            raise ProgramError(f"watchdog: no input for {silence:.3f} s, at most {limit:.3f} s allowed")
