"""What a person or a program holds of a run that is going on: end it, hold it, let it go on, confirm.

There is one object for every way to ask: the run's handle, another process, a signal, `Cell.stop()`. Its token is
cancelled once and for ever, by whoever asks first. After that nothing of the run begins anything new.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol


class Cancelled(RuntimeError):
    """Raised by `CancelToken.check` in work that is to end now; its text is the reason."""


class CancelToken:
    """Whether a run is to end, and why. Every method may be called from any thread."""

    def __init__(self, parent: "CancelToken | None" = None) -> None:
        """A token of its own, or a part of `parent` (one attempt at a step, a recovery) that ends with it."""
        self._lock = threading.Lock()
        self._reason: str | None = None
        self._hooks: list[Callable[[str], object]] = []
        self.event = threading.Event()
        if parent is not None:
            parent.on_cancel(self.cancel)

    @property
    def reason(self) -> str | None:
        """Why the run is to end, in the words of who asked first; None while it may go on."""
        return self._reason

    def cancel(self, reason: str) -> bool:
        """End the run. True for the first who asks; later reasons are not kept."""
        # A terminal may hand on bytes that are no text, which no file takes.
        reason = reason.encode(errors="backslashreplace").decode()
        with self._lock:
            if self._reason is not None:
                return False
            self._reason = reason
            hooks = list(self._hooks)
        self.event.set()
        for hook in hooks:
            hook(reason)
        return True

    def check(self) -> None:
        """Raise `Cancelled` if the run is to end. For loops that wait for no device."""
        if self._reason is not None:
            raise Cancelled(self._reason)

    def on_cancel(self, hook: Callable[[str], object]) -> None:
        """Call `hook(reason)` once when the run is to end: at once if it is to end already."""
        with self._lock:
            if self._reason is None:
                self._hooks.append(hook)
                return
        hook(self._reason)


class Asked(Protocol):
    """A request of another process: what is asked for, and why."""

    @property
    def kind(self) -> str:
        """One of `statemachine.journal.REQUESTS`."""

    @property
    def reason(self) -> str:
        """In the words of whoever asked."""

    @property
    def number(self) -> int | None:
        """Of the question that a confirmation answers."""


class RunControl:
    """The reins of one run; every method may be called from any thread."""

    def __init__(self) -> None:
        self.token = CancelToken()
        self.signal: int | None = None
        self.over = False
        """Set by the run once it has come to an end of its own."""
        self.late = False
        """Whether somebody asked to end the run when it had come to a good end already, or was just coming to it."""
        self.end_batch = False
        """Whether somebody asked that no other part of its batch is begun after this run."""
        self._lock = threading.RLock()
        self._paused = False
        self._wanted: str | None = None
        self._question = 0
        self._confirmed: str | None = None
        self._held_since: float | None = None
        self._held_s = 0.0

    def abort(self, reason: str, signal: int | None = None) -> None:
        """End the run as aborted: what moves is stopped at once. `signal` is the number of one that asked for it."""
        first = self.token.cancel(reason)
        # Looked at afterwards: the run may come to its end between the two.
        if self.over:
            self.late = True
        # A signal after the run's own end still tells the program to end.
        if signal is not None and self.signal is None and (first or self.over):
            self.signal = signal

    def pause(self) -> None:
        """Hold the run at its next safe point: before its next free motion, or its next step."""
        with self._lock:
            self._paused = True

    def go_on(self) -> None:
        """Let a held run go on."""
        with self._lock:
            self._paused = False

    def confirm(self, by: str, number: int | None = None) -> bool:
        """A person has looked and says that the run may go on; False when the run waits for nobody's word.

        Said before it is asked for, it does not count, nor with the `number` of another question: it could not have
        been about this.
        """
        with self._lock:
            if self._wanted is None or number not in (None, self._question):
                return False
            self._confirmed = by
            return True

    def obey(self, requests: Iterable[Asked]) -> None:
        """Do what other processes asked for."""
        for request in requests:
            match request.kind:
                case "abort":
                    self.abort(request.reason)
                case "pause":
                    self.pause()
                case "go-on":
                    self.go_on()
                case "confirm":
                    self.confirm(request.reason, request.number)
                case "end-batch":
                    self.end_batch = True

    def paused(self) -> bool:
        """Whether the run is asked to hold."""
        return self._paused

    @property
    def held_s(self) -> float:
        """Wall seconds that the run was held, until now: they count towards no deadline, and people come near."""
        with self._lock:
            since = self._held_since
            return self._held_s + (0.0 if since is None else time.monotonic() - since)

    def safe_point(
        self, token: CancelToken, say: Callable[[bool], None], check: Callable[[], None] = lambda: None
    ) -> None:
        """Stay here for as long as the run is paused; `say(True)` when it is held, `say(False)` when it goes on.

        Held on the wall's time, whatever the cell's clock; `check()` is called meanwhile, and raises when it finds that
        the work is to end. Raises `Cancelled` when `token` ends the work.
        """
        token.check()
        if not self.paused():
            return
        say(True)
        with self.held():
            while self.paused():
                if token.event.wait(0.02):
                    token.check()
                check()
        say(False)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Count this time as held."""
        with self._lock:
            self._held_since = time.monotonic()
        try:
            yield
        finally:
            with self._lock:
                self._held_s += time.monotonic() - (self._held_since or time.monotonic())
                self._held_since = None

    def ask(self, what: str) -> int:
        """From now on the run waits for a person's word about `what`; the number of this question."""
        with self._lock:
            self._wanted, self._confirmed = what, None
            self._question += 1
            return self._question

    @property
    def question(self) -> tuple[int, str] | None:
        """What the run waits for a person's word about, and the number of that question; None when it does not."""
        with self._lock:
            return None if self._wanted is None else (self._question, self._wanted)

    def answer(self) -> str | None:
        """Who has confirmed since `ask`, or None."""
        return self._confirmed

    def asked_no_more(self) -> None:
        """The run does not wait for a person any more."""
        with self._lock:
            self._wanted = None
