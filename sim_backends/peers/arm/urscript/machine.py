"""One URScript program as it runs: its threads, which take turns, each until its cycle ends, and what ends them."""

import inspect
from collections.abc import Callable, Generator
from traceback import walk_tb
from typing import Any

from sim_backends.peers.arm.commands import Context, Job, ProgramError
from sim_backends.peers.arm.urscript import commands, sockets
from sim_backends.peers.arm.urscript import environment as arithmetic
from sim_backends.peers.arm.urscript.environment import Commands, Environment, List, ScriptPose, Value, own
from sim_backends.peers.arm.urscript.translate import ScriptError, translate

Thread = Generator[None, None, object]
_MOST_TURNS = 20000
"""Turns of a program's loops and calls of its functions in one cycle; a controller calls more an infinite loop."""
_VALUES_A_TURN = 1000
"""So many values copied take as long as a turn."""
_MOST_THREADS = 100
_MAIN = -1
"""The program's own thread; scripts take 0 for no thread."""
_LIBRARIES: tuple[Callable[[Environment], Commands], ...] = (arithmetic.commands, commands.commands, sockets.commands)


class _Halt(Exception):
    """The program has ended itself."""


class Machine:
    """A compiled program; `run` is the job that carries it out."""

    def __init__(self, text: str, context: Context, environment: Environment) -> None:
        """Raises `ScriptError` when `text` does not compile."""
        self._environment = environment
        environment.context = context
        known = {name: act for library in _LIBRARIES for name, act in library(environment).items()}
        waiting = {name for name, act in known.items() if inspect.isgeneratorfunction(act)}
        at_once = known.keys() - waiting
        secondary = text.lstrip().startswith("sec ")
        try:
            program = translate(text, at_once, set() if secondary else waiting)
        except RecursionError as error:
            raise ScriptError("its expressions or blocks are nested too deeply") from error
        self.name = program.name
        self._places = program.places
        self._threads: dict[int, Thread] = {}
        self._turns = 0
        self._names: dict[str, Any] = known | {
            "__builtins__": {"bool": bool}, "List": List, "Pose": ScriptPose, "own": self._own, "turn": self._turn,
            "halt": _halt, "run": self._run_thread, "kill": self._kill, "join": self._join,
        }  # fmt: skip
        # The source holds nothing of the script's but numbers, texts and names with a `u_` before them.
        try:
            exec(compile(program.source, f"<{self.name}>", "exec"), self._names)
        except (SyntaxError, RecursionError, MemoryError, ValueError) as error:
            raise ScriptError(f"{self.name}: {error}") from error

    def run(self) -> Job:
        """Carry the program out, a cycle at a time, until its main thread ends. Raises `ProgramError`."""
        self._threads = {_MAIN: self._names[f"u_{self.name}"]()}
        try:
            while _MAIN in self._threads:
                self._round()
                if _MAIN in self._threads:
                    self._environment.end_cycle()
                    yield
        except _Halt:
            return
        finally:
            for number in list(self._threads):
                self._kill(number)
            self._environment.close()

    def run_at_once(self) -> None:
        """Carry a secondary program out, which has nothing that takes time. Raises `ProgramError`."""
        for _ in self.run():
            raise ProgramError(f"{self.name}: a secondary program may not take time")

    def _round(self) -> None:
        for number in sorted(self._threads, reverse=True):
            thread = self._threads.get(number)
            if thread is None:
                continue
            self._turns = 0
            self._environment.thread = number
            try:
                next(thread)
            except StopIteration:
                self._threads.pop(number, None)
            except _Halt:
                raise
            except Exception as error:
                # Whatever a script brings about ends the script, not the controller.
                raise self._located(error) from error

    def _located(self, error: Exception) -> ProgramError:
        """`error` in the words of the program, with the statement that brought it about."""
        if isinstance(error, ProgramError):
            found = ProgramError(str(error))
        elif isinstance(error, NameError):
            found = ProgramError(f"variable {str(error.name).removeprefix('u_')!r} is not defined")
        else:
            found = ProgramError(f"{self.name}: {str(error) or type(error).__name__}")
        for frame, number in walk_tb(error.__traceback__):
            if frame.f_code.co_filename == f"<{self.name}>":
                found.line, found.column = self._places[number - 1]
        return found

    def _own(self, value: Value) -> Value:
        copied, count = own(value)
        self._turn(count // _VALUES_A_TURN)
        return copied

    def _turn(self, count: int = 1) -> None:
        self._turns += count
        if self._turns > _MOST_TURNS:
            raise ProgramError(f"{self.name}: an infinite loop, {_MOST_TURNS} turns in one cycle")

    def _run_thread(self, name: str, thread: Thread) -> int:
        if len(self._threads) >= _MOST_THREADS:
            raise ProgramError(f"{self.name}: more than {_MOST_THREADS} threads")
        number = self._environment.next_thread()
        self._threads[number] = thread
        return number

    def _kill(self, number: int) -> None:
        thread = self._threads.pop(number, None)
        if thread is not None and number != self._environment.thread:
            thread.close()

    def _join(self, number: int) -> Job:
        while number in self._threads:
            yield


def _halt() -> None:
    raise _Halt
