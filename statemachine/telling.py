"""Tells what happens in a run: its journal, its observer, and the list of its faults for the report."""

from __future__ import annotations

import traceback
from collections.abc import Callable

from statemachine.journal import Journal
from statemachine.policy import Failure, Outcome
from statemachine.sequence import JobTrigger
from statemachine.step import Event, FaultRecord, Observer

JOURNALLED = frozenset(
    ("state", "safe_stop", "note", "fault", "confirm_needed", "confirmed", "paused", "going_on", "decided")
)
"""The kinds of events that are written to the journal; steps have a table of their own there."""


class Teller:
    """What happens in one run is told here, from any thread; `faults` are all that were told, in their order."""

    def __init__(self, journal: Journal, observer: Observer | None, state: Callable[[], str]) -> None:
        """`state()` is where the sequence is."""
        self.faults: list[FaultRecord] = []
        self._journal = journal
        self._observer = observer
        self._state = state

    def tell(self, event: Event) -> None:
        """Write to the journal what is not in its steps table, and tell the observer."""
        if event.kind in JOURNALLED:
            self._journal.event(event.kind, event.step, event.data)
        if event.kind == "fault":
            attempt, code, reason = (event.data[key] for key in ("attempt", "code", "reason"))
            remedy = str(event.data.get("remedy", "noted"))
            assert isinstance(attempt, int)
            self.faults.append(FaultRecord(event.at, event.step or "", attempt, str(code), str(reason), remedy=remedy))
        observer = self._observer
        if observer is not None:
            try:
                observer(event)
            # A display that fails must not end the job; it is told nothing more.
            except Exception as error:
                self._observer = None
                self._journal.event("observer_failed", event.step, {"error": f"{type(error).__name__}: {error}"})

    def changed(self, trigger: JobTrigger, source: str, target: str) -> None:
        """The sequence went from one state to another."""
        self.tell(Event("state", None, {"trigger": trigger.value, "from": str(source), "to": str(target)}))

    def stopped(self, reason: str, trouble: str | None) -> None:
        """The cell was brought to rest; `trouble` is what could not be confirmed."""
        self.tell(Event("safe_stop", None, {"reason": reason, "trouble": trouble}))

    def failed(self, step: str, attempt: int, end: Failure, remedy: str) -> None:
        """What went wrong and what was done about it, for the report; an end that was asked for is no fault."""
        if end.outcome is Outcome.ABORTED:
            return
        self.tell(Event("fault", step, {"attempt": attempt, "code": end.code, "reason": end.reason, "remedy": remedy}))

    def trace(self, error: BaseException) -> None:
        """Where an exception came from, for the journal alone."""
        text = "".join(traceback.format_exception(error))
        self._journal.event("traceback", self._state(), {"text": text})
