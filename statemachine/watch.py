"""Small pieces that keep a run in hand: work whose end can be awaited, and signals that are noted, not raised."""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Protocol, Self


class RunClock(Protocol):
    """The cell's clock: seconds that run `rate` times as fast as the wall."""

    rate: float

    def now(self) -> float:
        """Seconds."""

    def wait(self, event: threading.Event, timeout: float) -> bool:
        """Wait for `event`, at most `timeout` seconds of this clock; True when it was set."""


class Call:
    """A piece of work and what became of it: `done` is set when it has ended, with `result` or `error`."""

    def __init__(self) -> None:
        self.done = threading.Event()
        self.result: object = None
        self.error: BaseException | None = None

    def perform(self, work: Callable[[], object]) -> None:
        """Do it in this thread."""
        try:
            self.result = work()
        # Everything is handed to whoever watches, who decides what it means.
        except BaseException as error:
            self.error = error
        finally:
            self.done.set()


def begin(name: str, work: Callable[[], object]) -> Call:
    """Begin `work()` in a daemon thread of its own."""
    call = Call()
    threading.Thread(target=call.perform, args=(work,), name=name, daemon=True).start()
    return call


class SignalInterrupt(BaseException):
    """A signal asked the program to end, outside of any run. Like `KeyboardInterrupt`, nothing but the top takes it."""

    def __init__(self, number: int) -> None:
        super().__init__(said(number))
        self.number = number


def said(number: int) -> str:
    """A signal in words for the operator."""
    if number == signal.SIGINT:
        return "interrupted from the keyboard"
    return f"asked to end ({signal.Signals(number).name})"


class EndSignals:
    """Inside this context SIGTERM and SIGHUP, which would end the program without a word, raise `SignalInterrupt`.

    So does SIGINT with `keyboard`. Only the first one does: the cleaning up after it is not cut short by a second. Only
    where nobody else has a handler, and only in the main thread; contexts nest.
    """

    def __init__(self, keyboard: bool = False) -> None:
        self._numbers = [signal.SIGTERM, signal.SIGHUP, *([signal.SIGINT] if keyboard else [])]
        self._previous: dict[int, object] = {}
        self._raised = False

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in self._numbers:
                if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                    self._previous[number] = signal.signal(number, self._raise)
        return self

    def __exit__(self, *_: object) -> None:
        if threading.current_thread() is threading.main_thread():
            for number, handler in self._previous.items():
                signal.signal(number, handler)  # type: ignore[arg-type]
            self._previous = {}

    def _raise(self, number: int, frame: FrameType | None) -> None:
        if not self._raised:
            self._raised = True
            raise SignalInterrupt(number)


class SignalWatch:
    """Inside this context SIGINT, SIGTERM and SIGHUP are noted in `reason` and do not interrupt anything.

    So neither the first Ctrl-C nor a second one, however often it is pressed, can cut a safe stop short. Nested
    contexts see the signals of their own time. Does nothing outside the main thread, where Python allows no handlers.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._previous: dict[int, object] = {}

    @property
    def reason(self) -> str | None:
        """What to tell the operator, or None if no signal came."""
        return None if self.number is None else said(self.number)

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, frame: FrameType | None) -> None:
        # A plain attribute: taking a lock here could deadlock with the very thread that the signal broke into.
        if self.number is None:
            self.number = number
