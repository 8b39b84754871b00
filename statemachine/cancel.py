"""The one thing that says that a run is to end: seen by every step, plan, wait and recovery of that run.

A token is cancelled once and for ever, by whoever asks first: the operator, a signal, another process, a deadline, the
cell's health, `Cell.stop()`. After that nothing of the run begins anything new.
"""

from __future__ import annotations

import threading
from collections.abc import Callable


class Cancelled(RuntimeError):
    """Raised by `CancelToken.check` in work that is to end now; its text is the reason."""


class CancelToken:
    """Whether a run is to end, and why. Every method may be called from any thread."""

    def __init__(self, parent: CancelToken | None = None) -> None:
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
