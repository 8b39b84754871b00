"""The runs of one cell: one goes on at a time, and a stop counts for what was asked for before it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from cell.run.run import Run
from drivers.errors import Aborted, DeadlineError, InterlockError
from statemachine.step import Observer

CLOSE_WAIT_S = 20.0
"""Wall seconds that a run has to end when the cell is closed."""

Made = TypeVar("Made")

log = logging.getLogger(__name__)


class Runs:
    """The run that goes on, if any, and the stops so far, of the cell called `name`. Callable from any thread."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._beginning = threading.Lock()
        self._run: Run[Any] | None = None
        self._stops = 0
        self._stopped: Run[Any] | None = None
        self._closed = False

    @property
    def current(self) -> Run[Any] | None:
        """The run that is going on, or None."""
        run = self._run
        return None if run is None or run.done else run

    @property
    def stops(self) -> int:
        """How many stops there were so far."""
        return self._stops

    def require_free(self) -> None:
        """Raise `InterlockError` while a run is going on, or when the cell is closed."""
        if self._closed:
            raise InterlockError(self._name, "the cell was closed; open it again")
        if (going := self.current) is not None:
            raise InterlockError(
                self._name, f"a {going.kind} is going on; wait for its end or abort it, then begin again"
            )

    def require_no_late_stop(self) -> None:
        """Raise `Aborted`, once, when the last run was stopped just as it had come to its end."""
        stopped, self._stopped = self._stopped, None
        if stopped is not None and stopped.control.late:
            raise Aborted(
                f"the cell was stopped as the {stopped.kind} before had just ended; nothing was begun. See that it is "
                "safe, then begin the job again"
            )

    def begin(
        self, kind: str, work: Callable[[Run[Made]], Made], observer: Observer | None, stops: int | None
    ) -> Run[Made]:
        """Begin a run if none is going on. `stops` is their count when it was asked for; `Aborted` if another came."""
        with self._beginning:
            self.require_free()
            if stops not in (None, self._stops):
                raise Aborted(f"the cell was stopped before the {kind} began; nothing was begun")
            run = Run(kind, work, observer)
            self._run = run
            return run

    def stop(self) -> None:
        """Count a stop, and end the run that is going on."""
        with self._beginning:
            self._stops += 1
            run = self._stopped = self.current
        if run is not None:
            run.abort("stopped with Cell.stop()")

    def close(self) -> bool:
        """Let no run begin any more; False when that was said before."""
        with self._beginning:
            before, self._closed = self._closed, True
        return not before

    def end(self) -> None:
        """End the run that is going on because the cell is being closed, and wait for its end a while."""
        if (run := self.current) is None:
            return
        run.abort("the cell is being closed")
        try:
            run.ended(CLOSE_WAIT_S)
        except DeadlineError as error:
            log.warning("closing the cell: %s", error)
