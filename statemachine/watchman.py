"""Looks around while a run's work goes on, ends it when it has to end, and brings the cell to rest.

What ends work: a request of a person or a program, a signal, its deadline, the cell's health. All is told here.
"""

import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from statemachine.control import CancelToken, RunControl
from statemachine.journal import Journal, JournalError
from statemachine.sequence import JobTrigger
from statemachine.step import Event, Failure, FaultRecord, Observer, Outcome, Policy, StepOverrun
from statemachine.waiting import POLL_S, Waiting
from statemachine.watch import Call, RunClock, SignalWatch

JOURNALLED = frozenset(
    ("state", "safe_stop", "note", "fault", "confirm_needed", "confirmed", "paused", "going_on", "decided")
)
"""The kinds of events that are written to the journal; steps have a table of their own there."""


class EventLog:
    """What happens in one run is told here, from any thread; `faults` are all that were told, in their order."""

    def __init__(self, journal: Journal, observer: Observer | None, state: Callable[[], str]) -> None:
        """`state()` is where the sequence is."""
        self.faults: list[FaultRecord] = []
        self._journal = journal
        self._observer = observer
        self._state = state

    def notify(self, event: Event) -> None:
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
        self.notify(Event("state", None, {"trigger": trigger.value, "from": str(source), "to": str(target)}))

    def stopped(self, reason: str, trouble: str | None) -> None:
        """The cell was brought to rest; `trouble` is what could not be confirmed."""
        self.notify(Event("safe_stop", None, {"reason": reason, "trouble": trouble}))

    def failed(self, step: str, attempt: int, end: Failure, remedy: str) -> None:
        """What went wrong and what was done about it, for the report; an end that was asked for is no fault."""
        if end.outcome is Outcome.ABORTED:
            return
        self.notify(
            Event("fault", step, {"attempt": attempt, "code": end.code, "reason": end.reason, "remedy": remedy})
        )

    def trace(self, error: BaseException) -> None:
        """Where an exception came from, for the journal alone."""
        text = "".join(traceback.format_exception(error))
        self._journal.event("traceback", self._state(), {"text": text})


REQUEST_POLLS = 10
"""The journal's requests are looked at every so many polls."""
HEALTH_POLLS = 5
"""The cell's health is looked at every so many polls."""


@dataclass
class Watchman:
    """Watches over one run, with what the `Runner` was given.

    `error` is the exception behind the newest end. `abandoned` says that work did not end after its stop: it still goes
    on in a thread that nobody waits for. `at_rest` says that no work has begun since the newest stop.
    """

    policy: Policy
    journal: Journal
    clock: RunClock
    control: RunControl
    classify: Callable[[BaseException], Failure]
    safe_stop: Callable[[str], None]
    health: Callable[[], None] | None
    waiting: Waiting
    signals: SignalWatch
    events: EventLog
    error: BaseException | None = field(default=None, init=False)
    abandoned: bool = field(default=False, init=False)
    at_rest: bool = field(default=False, init=False)
    _polls: int = field(default=0, init=False)
    _ailment: Exception | None = field(default=None, init=False)

    def watch(
        self, what: str, work: Callable[[], object], deadline: float, token: CancelToken, ailing: bool = False
    ) -> tuple[Call, Failure | None]:
        """Have `work` done; on a request, a signal or the deadline end it, stop the cell and say why. With `ailing` the
        cell's health is looked at as well. Time for which the run is held does not count."""
        cause: Failure | None = None
        trouble: str | None = None
        held = self.control.held_s
        self.at_rest = False

        def cut() -> str | None:
            nonlocal cause, trouble
            cause = self._cause(what, deadline, held, ailing)
            if cause is None:
                return None
            token.cancel(cause.reason)
            trouble = self.halt(cause.reason)
            return cause.reason

        call = self.waiting.do(what, work, cut, self.policy.grace_s)
        if cause is None:
            return call, None
        ailment, self._ailment = self._ailment, None
        if ailment is not None:
            self.events.trace(ailment)
        if not call.done.is_set():
            self.abandoned = True
            text = f"{cause.reason}; {what} was still busy {self.policy.grace_s:g} s after the stop"
            cause = replace(cause, reason=text)
        self.events.stopped(cause.reason, trouble)
        return call, cause

    def _cause(self, what: str, deadline: float, held: float, ailing: bool) -> Failure | None:
        """What is to end the work `what` now, if anything."""
        try:
            cause = self.asked()
        except JournalError as error:
            self.error = error
            return Failure(Outcome.FAULTED, f"the run could not go on: {error}", "run.journal")
        if cause is None and ailing:
            cause = self._ails()
        if cause is None and self.clock.now() > deadline + (self.control.held_s - held) * self.clock.rate:
            self.error = StepOverrun(f"{what} did not end within its deadline and was stopped")
            cause = Failure(Outcome.FAULTED, str(self.error), "step.deadline")
        return cause

    def asked(self) -> Failure | None:
        """The end that somebody asked for, if any."""
        self._polls += 1
        if self.signals.reason is not None:
            self.control.abort(self.signals.reason, self.signals.number)
        # Who asked in this process does not wait for the disk.
        if self.control.token.reason is None and self._polls % REQUEST_POLLS == 1:
            self.control.obey(self.journal.take_requests())
        if (reason := self.control.token.reason) is not None:
            return Failure(Outcome.ABORTED, reason, "request" if self.control.signal is None else "signal")
        return None

    def _ails(self) -> Failure | None:
        """What `health` raises, if anything."""
        if self._polls % HEALTH_POLLS or (error := self.examine()) is None:
            return None
        # It is written down once the cell stands: a disk may stall.
        self.error = self._ailment = error
        return self.classified(error)

    def examine(self) -> Exception | None:
        """What ails the cell now, if anything."""
        try:
            if self.health is not None:
                self.health()
        except Exception as error:
            return error
        return None

    def wait_briefly(self) -> Failure | None:
        """Wait for one poll, or less if the run is to end; the end that somebody asked for, if any. On the wall's time:
        it is for a person, and the cell stands."""
        self.control.token.event.wait(POLL_S)
        return self.asked()

    def judge(self, error: BaseException) -> Failure:
        """What an exception means for the run; where it came from is written down."""
        if isinstance(error, KeyboardInterrupt | SystemExit):
            return Failure(Outcome.ABORTED, f"ended by {type(error).__name__}", "interrupt")
        self.events.trace(error)
        return self.classified(error)

    def classified(self, error: BaseException) -> Failure:
        """What an exception means for the run, whatever becomes of `classify`."""
        try:
            return self.classify(error)
        except Exception as second:
            text = f"{type(error).__name__}: {error} (it could not be classified: {second})"
            return Failure(Outcome.FAULTED, text, "run.internal")

    def halt(self, reason: str) -> str | None:
        """Call `safe_stop` where no signal reaches it; what went wrong with it, or None."""
        self.at_rest = True
        until = self.clock.now() + self.policy.stop_deadline_s * self.clock.rate
        late = f"it did not end within {self.policy.stop_deadline_s:g} s"
        call = self.waiting.do(
            "safe stop", lambda: self.safe_stop(reason), lambda: late if self.clock.now() > until else None, 0.0
        )
        # In line an inner wait looks around in the place of this one: it ends, but late.
        if not call.done.is_set() or (call.error is None and self.clock.now() > until):
            return late
        return None if call.error is None else f"{type(call.error).__name__}: {call.error}"

    def halt_before(self, reason: str, end: Failure) -> Failure | None:
        """Bring the cell to rest before the run goes on after `end`; the end of the run if that was not confirmed."""
        trouble = self.halt(reason)
        self.events.stopped(reason, trouble)
        if trouble is None:
            return None
        return Failure(Outcome.FAULTED, f"{end.reason}; the safe stop after it failed: {trouble}", "safe_stop")
