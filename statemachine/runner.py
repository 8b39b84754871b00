"""Drives a sequence of steps to its end, whatever happens, and ends it safe.

The work is done by the steps that are passed in; the runner watches deadlines, requests and signals meanwhile (see
`statemachine.waiting` for how), repeats what the policy lets it repeat, and writes everything to the journal as it
happens. It knows neither devices nor the cell: exceptions are judged by `classify`, the cell is brought to rest by
`safe_stop`.
"""

from __future__ import annotations

import math
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from statemachine.cancel import CancelToken
from statemachine.control import RunControl
from statemachine.journal import Journal, JournalError
from statemachine.policy import Failure, OnFailure, Outcome, Policy, Step
from statemachine.script import NO_SCRIPT, Again, Script
from statemachine.sequence import Sequence, SequenceError, Trigger
from statemachine.step import (
    Event,
    FaultRecord,
    Observer,
    RunResult,
    StepCall,
    StepContext,
    StepOverrun,
    StepRecord,
    summary_of,
)
from statemachine.waiting import POLL_S, Waiting, waiting_on
from statemachine.watch import Call, Clock, SignalWatch

__all__ = ["Event", "FaultRecord", "RunResult", "Runner", "StepContext", "StepRecord"]

REQUEST_POLLS = 10
"""The journal's requests are looked at every so many polls."""
HEALTH_POLLS = 5
"""The cell's health is looked at every so many polls."""

JOURNALLED = frozenset(
    ("state", "safe_stop", "note", "fault", "confirm_needed", "confirmed", "paused", "going_on", "decided")
)
"""The kinds of events that are written to the journal; steps have a table of their own there."""

Recover = Callable[[BaseException, CancelToken, bool], None]

_END_TRIGGERS = {
    Outcome.REFUSED: Trigger.REFUSE,
    Outcome.FAULTED: Trigger.FAULT,
    Outcome.ABORTED: Trigger.ABORT,
}


@dataclass
class Runner:
    """Runs one job. `run()` is called once; what a person or another program asks comes through `control`.

    `steps` maps step names to what does them. `safe_stop(reason)` brings the cell to rest: laser off, everything
    stopped. It must be idempotent and leave a cell that can go on, since it is called when a step fails or is cut
    short, before every repetition, and exactly once more at the end of every run. `recover(error, token, confirmed)`
    clears a recoverable fault, begins nothing once `token` is cancelled, and is told whether a person has confirmed.
    `health()` is called about ten times a second while a step works, and raises what must end it whatever it does.
    """

    sequence: Sequence
    steps: Mapping[str, StepCall]
    policy: Policy
    journal: Journal
    clock: Clock
    classify: Callable[[BaseException], Failure]
    safe_stop: Callable[[str], None]
    observer: Observer | None = None
    recover: Recover | None = None
    health: Callable[[], None] | None = None
    control: RunControl = field(default_factory=RunControl)
    script: Script = NO_SCRIPT
    _waiting: Waiting = field(init=False)
    _polls: int = field(default=0, init=False)
    _signals: SignalWatch = field(default_factory=SignalWatch, init=False)
    _records: dict[str, StepRecord] = field(default_factory=dict, init=False)
    _results: dict[str, object] = field(default_factory=dict, init=False)
    _faults: list[FaultRecord] = field(default_factory=list, init=False)
    _error: BaseException | None = field(default=None, init=False)
    _abandoned: bool = field(default=False, init=False)
    _ailment: Exception | None = field(default=None, init=False)
    _met: Exception | None = field(default=None, init=False)
    _tries: int = field(default=1, init=False)
    _decisions: Counter[str] = field(default_factory=Counter, init=False)

    def __post_init__(self) -> None:
        missing = [name for name in self.sequence.steps if name not in self.steps]
        if missing:
            raise ValueError(f"no work was given for {', '.join(missing)}")
        self._records = {name: StepRecord(name) for name in self.sequence.steps}
        self._waiting = waiting_on(self.clock)

    def run(self, done: Mapping[str, object] | None = None) -> RunResult:
        """Do the steps that are not in `done` (results of an earlier run by step name) and return how it ended.

        Raises nothing: every exception of a step, of the journal or of the runner itself becomes an outcome, after
        the safe stop.
        """
        for name, result in (done or {}).items():
            self.sequence.facts.done.add(name)
            self._results[name] = result
            self._records[name] = StepRecord(name, "resumed")
        self.sequence.on_change = self._on_change
        with SignalWatch() as self._signals:
            try:
                end = self._drive()
            except Exception as error:
                self._error = error
                end = Failure(Outcome.FAULTED, f"the run could not go on: {error}", "run.internal")
            return self._finish(end)

    # --- the walk through the sequence ---

    def _drive(self) -> Failure | None:
        """Walk through the steps; None when all are done, else why not."""
        if (end := self._ask()) is not None:
            return end
        self.sequence.fire(Trigger.START)
        while (state := self.sequence.state) in self.sequence.steps:
            self._tries = 1
            end = self._hold() or self._perform(self.policy.of(state)) or self._after(state)
            if end is None:
                self.sequence.facts.done.add(state)
                self.sequence.fire(Trigger.NEXT)
            elif (end := self._again(state, end)) is not None:
                self._note_fault(state, self._tries, end, "ended the run")
                return end
        return None

    def _after(self, name: str) -> Failure | None:
        """What the script does after a step: why that ends the run, or None."""
        if (look := self.script.after.get(name)) is None:
            return None
        result = self._results[name]
        return self._scripted(name, lambda: look(result))[0]

    def _again(self, name: str, end: Failure) -> Failure | None:
        """Ask the script about a refusal: None when the run goes on from a step of its choice, else why it ends."""
        decide = self.script.on_refusal
        if decide is None or end.outcome is not Outcome.REFUSED:
            return end
        if self._decisions[name] >= self.script.most:
            text = f"{end.reason}; the script has decided about {name} {self.script.most} times, the most allowed"
            return replace(end, reason=text)
        self._decisions[name] += 1
        failed, chosen = self._scripted(name, lambda: decide(name, end))
        if failed is not None or not isinstance(chosen, Again):
            return failed or end
        steps = self.sequence.steps
        allowed = steps[: steps.index(name) + 1]
        if chosen.step not in allowed:
            text = f"{end.reason}; the script chose to go on from {chosen.step!r}, allowed: {', '.join(allowed)}"
            return replace(end, reason=text)
        if (unsafe := self._stop(f"before {chosen.step} is done again", end)) is not None:
            return unsafe
        self._note_fault(name, self._tries, end, f"again from {chosen.step}")
        self._tell(Event("decided", name, {"reason": end.reason, "again": chosen.step, "why": chosen.why}))
        for later in steps[steps.index(chosen.step) :]:
            self._results.pop(later, None)
            self._records[later] = replace(self._records[later], state="open")
        self.sequence.facts.chosen = chosen.step
        self.sequence.fire(Trigger.AGAIN)
        return None

    def _scripted(self, name: str, work: Callable[[], object]) -> tuple[Failure | None, object]:
        """Let the script work between two steps: why that ended the run, or None, and what it gave."""
        token = CancelToken(self.control.token)
        call, end = self._watch(f"the script after {name}", work, math.inf, token, ailing=True)
        if end is None and call.error is not None:
            self._error = call.error
            end = self._ask() or self._judge(call.error)
        return end, call.result

    def _perform(self, step: Step) -> Failure | None:
        """Do one step, with its repetitions; None when it has succeeded."""
        attempt = 1
        while (end := self._attempt(step, attempt)) is not None:
            left = step.max_retries + 1 - attempt
            error = self._error
            if left == 0 or error is None or self._abandoned or end.outcome is Outcome.ABORTED:
                return end
            self.sequence.facts.retries_left = left
            self.sequence.facts.recoverable = end.recoverable
            if step.retries(error):
                if (unsafe := self._stop(f"before {step.name} is tried again", end)) is not None:
                    return unsafe
                self._note_fault(step.name, attempt, end, "tried again")
                self.sequence.fire(Trigger.RETRY)
            elif end.recoverable and step.on_failure is OnFailure.RECOVER and self.recover is not None:
                failed, by = self._recover(step, end, error, self.recover)
                if failed is not None:
                    return failed
                self._note_fault(step.name, attempt, end, f"confirmed by {by}, recovered" if by else "recovered")
            else:
                return end
            if (asked := self._hold()) is not None:
                return asked
            attempt += 1
        return None

    def _recover(
        self, step: Step, end: Failure, error: BaseException, recover: Recover
    ) -> tuple[Failure | None, str | None]:
        """Clear a fault: why that ended the run, or None; and who has confirmed it, where that was needed."""
        self.sequence.fire(Trigger.FAULT)
        # The failed attempt was stopped already. A device that is to be recovered may not have confirmed it; after the
        # recovery all have to.
        by = None
        if end.needs_person:
            refused, by = self._person(step, end)
            if refused is not None:
                return refused, None
        self.sequence.fire(Trigger.RECOVER)
        token = CancelToken(self.control.token)
        deadline = self.clock.now() + self.policy.recovery_deadline_s
        call, failed = self._watch("the recovery", lambda: recover(error, token, by is not None), deadline, token)
        if failed is None and call.error is not None:
            self._error = call.error
            failed = self._ask()
        if failed is None and call.error is not None:
            judged = self._judge(call.error)
            failed = replace(judged, outcome=Outcome.FAULTED, reason=f"{error}; the recovery failed: {judged.reason}")
        if failed is None:
            failed = self._stop(f"recovered, before {step.name} is tried again", end)
        if failed is None:
            self.sequence.fire(Trigger.RECOVERED)
        return failed, by

    def _person(self, step: Step, end: Failure) -> tuple[Failure | None, str | None]:
        """Wait until a person has confirmed: why that ended the run, or None; and who it was."""
        if self.policy.simulated_person:
            by = "the simulated person"
        else:
            number = self.control.ask(end.reason)
            self._tell(Event("confirm_needed", step.name, {"reason": end.reason, "code": end.code, "number": number}))
            try:
                until = time.monotonic() + self.policy.confirm_deadline_s
                while (found := self.control.answer()) is None:
                    if (asked := self._pause_briefly()) is not None:
                        return asked, None
                    if time.monotonic() > until:
                        text = f"{end.reason}; nobody confirmed within {self.policy.confirm_deadline_s:g} s"
                        return replace(end, outcome=Outcome.FAULTED, reason=text), None
                by = found
            finally:
                self.control.asked_no_more()
        self._tell(Event("confirmed", step.name, {"by": by, "reason": end.reason}))
        return None, by

    def _attempt(self, step: Step, attempt: int) -> Failure | None:
        """One try: None, or the end that it leads to unless it is repeated."""
        self._tries = attempt
        met, self._met = self._met, None
        started, begun = self.clock.now(), time.monotonic()
        deadline = started + step.deadline_s * (self.clock.rate if step.on_wall else 1.0)
        context = StepContext(
            step, attempt, deadline, dict(self._results), self.clock, self._tell, self.control, self._waiting.look
        )
        key = self.journal.step_started(step.name, attempt)
        self._tell(Event("step_started", step.name, {"attempt": attempt}))
        self._error = None
        call, end = self._watch(step.name, lambda: self._begin(context, met), deadline, context.token, ailing=True)
        context.token.cancel(f"{step.name} has ended")
        if end is None and call.error is not None:
            self._error = call.error
            # At rest before anything is read or written: a disk may stall.
            stopped = f"{step.name} failed"
            trouble = self._halt(stopped)
            end = self._ask() or self._judge(call.error)
            self._tell(Event("safe_stop", None, {"reason": stopped, "trouble": trouble}))
        duration = self.clock.now() - started
        before = self._records[step.name]
        wall = before.wall_s + time.monotonic() - begun
        state = "done" if end is None else "failed"
        retries = before.retries + (attempt > 1)
        self._records[step.name] = StepRecord(step.name, state, before.duration_s + duration, retries, wall)
        if end is not None:
            self.journal.step_ended(key, duration, error=end.reason)
            self._tell(Event("step_failed", step.name, {"attempt": attempt, "reason": end.reason}))
            return end
        summary = summary_of(call.result) or {}
        self._results[step.name] = call.result
        self.journal.step_ended(key, duration, summary)
        self._tell(Event("step_done", step.name, {"duration_s": duration, **summary}))
        return None

    def _begin(self, context: StepContext, met: Exception | None) -> object:
        """A step's work, in a cell that is well; what was `met` while the run was held fails the attempt here."""
        if met is not None:
            raise met
        if self.health is not None:
            self.health()
        return self.steps[context.step.name](context)

    # --- watching ---

    def _watch(
        self, what: str, work: Callable[[], object], deadline: float, token: CancelToken, ailing: bool = False
    ) -> tuple[Call, Failure | None]:
        """Have `work` done; on a request, a signal or the deadline end it, stop the cell and say why.

        With `ailing` the cell's health is looked at as well. Time for which the run is held does not count.
        """
        cause: Failure | None = None
        trouble: str | None = None
        held = self.control.held_s

        def cut() -> str | None:
            nonlocal cause, trouble
            cause = self._cause(what, deadline, held, ailing)
            if cause is None:
                return None
            token.cancel(cause.reason)
            trouble = self._halt(cause.reason)
            return cause.reason

        call = self._waiting.do(what, work, cut, self.policy.grace_s)
        if cause is None:
            return call, None
        ailment, self._ailment = self._ailment, None
        if ailment is not None:
            self._trace(ailment)
        if not call.done.is_set():
            self._abandoned = True
            text = f"{cause.reason}; {what} was still busy {self.policy.grace_s:g} s after the stop"
            cause = replace(cause, reason=text)
        self._tell(Event("safe_stop", None, {"reason": cause.reason, "trouble": trouble}))
        return call, cause

    def _cause(self, what: str, deadline: float, held: float, ailing: bool) -> Failure | None:
        """What is to end the work `what` now, if anything."""
        try:
            cause = self._ask()
        except JournalError as error:
            self._error = error
            return Failure(Outcome.FAULTED, f"the run could not go on: {error}", "run.journal")
        if cause is None and ailing:
            cause = self._ail()
        if cause is None and self.clock.now() > deadline + (self.control.held_s - held) * self.clock.rate:
            self._error = StepOverrun(f"{what} did not end within its deadline and was stopped")
            cause = Failure(Outcome.FAULTED, str(self._error), "step.deadline")
        return cause

    def _ask(self) -> Failure | None:
        """The end that somebody asked for, if any."""
        self._polls += 1
        if self._signals.reason is not None:
            self.control.abort(self._signals.reason, self._signals.number)
        # Who asked in this process does not wait for the disk.
        if self.control.token.reason is None and self._polls % REQUEST_POLLS == 1:
            self.control.obey(self.journal.take_requests())
        if (reason := self.control.token.reason) is not None:
            return Failure(Outcome.ABORTED, reason, "request" if self.control.signal is None else "signal")
        return None

    def _ail(self) -> Failure | None:
        """What `health` raises, if anything."""
        if self._polls % HEALTH_POLLS or (error := self._examine()) is None:
            return None
        # It is written down once the cell stands: a disk may stall.
        self._error = self._ailment = error
        return self._classified(error)

    def _examine(self) -> Exception | None:
        try:
            if self.health is not None:
                self.health()
        except Exception as error:
            return error
        return None

    def _hold(self) -> Failure | None:
        """Stay paused for as long as it is asked for and the cell is well; what ails it fails the next attempt."""
        end = self._ask()
        if end is None and self.control.paused():
            step = self.sequence.state
            self.sequence.fire(Trigger.PAUSE)
            self._tell(Event("paused", step, {"text": f"held before {step}"}))
            while end is None and self.control.paused() and self._met is None:
                end = self._pause_briefly()
                self._met = self._examine()
            if end is None:
                self.sequence.fire(Trigger.RESUME)
                text = "goes on" if self._met is None else f"held no longer: {self._met}"
                self._tell(Event("going_on", step, {"text": text}))
        return end

    def _pause_briefly(self) -> Failure | None:
        """Wait for one poll, or less if the run is to end; the end that somebody asked for, if any.

        On the wall's time: it is for a person, and the cell stands.
        """
        self.control.token.event.wait(POLL_S)
        return self._ask()

    def _judge(self, error: BaseException) -> Failure:
        if isinstance(error, KeyboardInterrupt | SystemExit):
            return Failure(Outcome.ABORTED, f"ended by {type(error).__name__}", "interrupt")
        self._trace(error)
        return self._classified(error)

    def _trace(self, error: BaseException) -> None:
        text = "".join(traceback.format_exception(error))
        self.journal.event("traceback", str(self.sequence.state), {"text": text})

    def _classified(self, error: BaseException) -> Failure:
        try:
            return self.classify(error)
        except Exception as second:
            text = f"{type(error).__name__}: {error} (it could not be classified: {second})"
            return Failure(Outcome.FAULTED, text, "run.internal")

    # --- the end ---

    def _halt(self, reason: str) -> str | None:
        """Call `safe_stop` where no signal reaches it; what went wrong with it, or None."""
        until = self.clock.now() + self.policy.stop_deadline_s * self.clock.rate
        late = f"it did not end within {self.policy.stop_deadline_s:g} s"
        call = self._waiting.do(
            "safe stop", lambda: self.safe_stop(reason), lambda: late if self.clock.now() > until else None, 0.0
        )
        if not call.done.is_set():
            return late
        return None if call.error is None else f"{type(call.error).__name__}: {call.error}"

    def _stop(self, reason: str, end: Failure) -> Failure | None:
        """Bring the cell to rest before the run goes on after `end`; the end of the run if that was not confirmed."""
        trouble = self._halt(reason)
        self._tell(Event("safe_stop", None, {"reason": reason, "trouble": trouble}))
        if trouble is None:
            return None
        return Failure(Outcome.FAULTED, f"{end.reason}; the safe stop after it failed: {trouble}", "safe_stop")

    def _finish(self, end: Failure | None) -> RunResult:
        outcome = Outcome(self.sequence.success.value) if end is None else end.outcome
        reason = f"end of the run ({outcome.value})"
        # Whoever still works in an abandoned thread begins nothing any more.
        self.control.over = True
        if not self.control.token.cancel("the run has ended") and end is None:
            self.control.late = True
        trouble = self._halt(reason)
        said = "all steps done" if end is None else end.reason
        if trouble is not None:
            end = Failure(Outcome.FAULTED, f"{said}; the safe stop failed: {trouble}", "safe_stop")
        try:
            if trouble is not None and end is not None:
                self._note_fault("", 0, end, "ended the run")
            self._tell(Event("safe_stop", None, {"reason": reason, "trouble": trouble}))
            if end is not None:
                self.sequence.fire(_END_TRIGGERS[end.outcome])
                outcome, said = end.outcome, end.reason
            self.journal.run_ended(outcome.value, said)
        except (JournalError, SequenceError) as error:
            outcome = Outcome.FAULTED
            end = Failure(outcome, f"{said}; the end could not be recorded: {error}", "run.internal")
            said = end.reason
        self._tell(Event("run_ended", None, {"outcome": outcome.value, "reason": said}))
        records = tuple(self._records[name] for name in self.sequence.steps)
        code = "" if end is None else end.code
        return RunResult(
            outcome, said, code, records, dict(self._results), self._error, self.control.signal, tuple(self._faults)
        )

    # --- telling ---

    def _note_fault(self, step: str, attempt: int, end: Failure, remedy: str) -> None:
        """Keep what went wrong and what was done about it, for the report; an end that was asked for is no fault."""
        if end.outcome is Outcome.ABORTED:
            return
        self._tell(Event("fault", step, {"attempt": attempt, "code": end.code, "reason": end.reason, "remedy": remedy}))

    def _on_change(self, trigger: Trigger, source: str, target: str) -> None:
        self._tell(Event("state", None, {"trigger": trigger.value, "from": str(source), "to": str(target)}))

    def _tell(self, event: Event) -> None:
        """Write to the journal what is not in its steps table, and tell the observer; from any thread."""
        if event.kind in JOURNALLED:
            self.journal.event(event.kind, event.step, event.data)
        if event.kind == "fault":
            attempt, code, reason = (event.data[key] for key in ("attempt", "code", "reason"))
            remedy = str(event.data.get("remedy", "noted"))
            assert isinstance(attempt, int)
            self._faults.append(FaultRecord(event.at, event.step or "", attempt, str(code), str(reason), remedy))
        observer = self.observer
        if observer is not None:
            try:
                observer(event)
            # A display that fails must not end the job; it is told nothing more.
            except Exception as error:
                self.observer = None
                self.journal.event("observer_failed", event.step, {"error": f"{type(error).__name__}: {error}"})
