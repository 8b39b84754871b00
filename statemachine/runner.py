"""Drives a sequence of steps to its end, whatever happens, and ends it safe.

The work is done by the steps that are passed in. The runner has them watched (`statemachine.watchman`), repeats what
the policy lets it repeat, and writes everything to the journal as it happens. It knows neither devices nor the cell:
exceptions are judged by `classify`, the cell is brought to rest by `safe_stop`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from statemachine.cancel import CancelToken
from statemachine.control import RunControl
from statemachine.journal import Journal, JournalError
from statemachine.policy import Failure, OnFailure, Outcome, Policy, Step
from statemachine.script import NO_SCRIPT, Again, Script
from statemachine.scripting import Scripting
from statemachine.sequence import Sequence, SequenceError, Trigger
from statemachine.standing import await_word, hold
from statemachine.step import (
    Event,
    FaultRecord,
    Observer,
    RunResult,
    StepCall,
    StepContext,
    StepRecord,
    summary_of,
)
from statemachine.telling import Teller
from statemachine.waiting import waiting_on
from statemachine.watch import Clock, SignalWatch
from statemachine.watchman import Watchman

__all__ = ["Event", "FaultRecord", "RunResult", "Runner", "StepContext", "StepRecord"]

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
    _watchman: Watchman = field(init=False)
    _teller: Teller = field(init=False)
    _records: dict[str, StepRecord] = field(default_factory=dict, init=False)
    _results: dict[str, object] = field(default_factory=dict, init=False)
    _met: Exception | None = field(default=None, init=False)
    _tries: int = field(default=1, init=False)

    def __post_init__(self) -> None:
        missing = [name for name in self.sequence.steps if name not in self.steps]
        if missing:
            raise ValueError(f"no work was given for {', '.join(missing)}")
        self._records = {name: StepRecord(name) for name in self.sequence.steps}

    def run(self, done: Mapping[str, object] | None = None) -> RunResult:
        """Do the steps that are not in `done` (results of an earlier run by step name) and return how it ended.

        Raises nothing: every exception of a step, of the journal or of the runner itself becomes an outcome, after
        the safe stop.
        """
        for name, result in (done or {}).items():
            self.sequence.facts.done.add(name)
            self._results[name] = result
            self._records[name] = StepRecord(name, "resumed")
        self._teller = Teller(self.journal, self.observer, lambda: str(self.sequence.state))
        self.sequence.on_change = self._teller.changed
        with SignalWatch() as signals:
            self._watchman = Watchman(
                policy=self.policy,
                journal=self.journal,
                clock=self.clock,
                control=self.control,
                classify=self.classify,
                safe_stop=self.safe_stop,
                health=self.health,
                waiting=waiting_on(self.clock),
                signals=signals,
                teller=self._teller,
            )
            try:
                end = self._drive()
            except Exception as error:
                self._watchman.error = error
                end = Failure(Outcome.FAULTED, f"the run could not go on: {error}", "run.internal")
            return self._finish(end)

    # --- the walk through the sequence ---

    def _drive(self) -> Failure | None:
        """Walk through the steps; None when all are done, else why not."""
        if (end := self._watchman.asked()) is not None:
            return end
        script = Scripting(self.script, self.sequence.steps, self._watchman)
        self.sequence.fire(Trigger.START)
        while (state := self.sequence.state) in self.sequence.steps:
            self._tries = 1
            end = self._hold() or self._perform(self.policy.of(state)) or script.after(state, self._results.get(state))
            if end is None:
                self.sequence.facts.done.add(state)
                self.sequence.fire(Trigger.NEXT)
                continue
            decided = script.decide(state, end)
            end = self._go_back(state, end, decided) if isinstance(decided, Again) else decided
            if end is not None:
                self._teller.failed(state, self._tries, end, "ended the run")
                return end
        return None

    def _hold(self) -> Failure | None:
        """Stay here while the run is paused; what ails the cell meanwhile fails the next attempt."""
        end, self._met = hold(self.sequence, self._watchman)
        return end

    def _go_back(self, name: str, end: Failure, chosen: Again) -> Failure | None:
        """Go on from the step that the script chose after the end of step `name`; why that ends the run, or None."""
        if (unsafe := self._watchman.halt_before(f"before {chosen.step} is done again", end)) is not None:
            return unsafe
        self._teller.failed(name, self._tries, end, f"again from {chosen.step}")
        self._teller.tell(Event("decided", name, {"reason": end.reason, "again": chosen.step, "why": chosen.why}))
        steps = self.sequence.steps
        for later in steps[steps.index(chosen.step) :]:
            self._results.pop(later, None)
            self._records[later] = replace(self._records[later], state="open")
        self.sequence.facts.chosen = chosen.step
        self.sequence.fire(Trigger.AGAIN)
        return None

    def _perform(self, step: Step) -> Failure | None:
        """Do one step, with its repetitions; None when it has succeeded."""
        attempt = 1
        while (end := self._attempt(step, attempt)) is not None:
            left = step.max_retries + 1 - attempt
            error = self._watchman.error
            if left == 0 or error is None or self._watchman.abandoned or end.outcome is Outcome.ABORTED:
                return end
            self.sequence.facts.retries_left = left
            self.sequence.facts.recoverable = end.recoverable
            if step.retries(error):
                if (unsafe := self._watchman.halt_before(f"before {step.name} is tried again", end)) is not None:
                    return unsafe
                self._teller.failed(step.name, attempt, end, "tried again")
                self.sequence.fire(Trigger.RETRY)
            elif end.recoverable and step.on_failure is OnFailure.RECOVER and self.recover is not None:
                failed, by = self._recover(step, end, error, self.recover)
                if failed is not None:
                    return failed
                self._teller.failed(step.name, attempt, end, f"confirmed by {by}, recovered" if by else "recovered")
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
            refused, by = await_word(step, end, self._watchman)
            if refused is not None:
                return refused, None
        self.sequence.fire(Trigger.RECOVER)
        token = CancelToken(self.control.token)
        deadline = self.clock.now() + self.policy.recovery_deadline_s
        call, failed = self._watchman.watch(
            "the recovery", lambda: recover(error, token, by is not None), deadline, token
        )
        if failed is None and call.error is not None:
            self._watchman.error = call.error
            failed = self._watchman.asked()
        if failed is None and call.error is not None:
            judged = self._watchman.judge(call.error)
            failed = replace(judged, outcome=Outcome.FAULTED, reason=f"{error}; the recovery failed: {judged.reason}")
        if failed is None:
            failed = self._watchman.halt_before(f"recovered, before {step.name} is tried again", end)
        if failed is None:
            self.sequence.fire(Trigger.RECOVERED)
        return failed, by

    def _attempt(self, step: Step, attempt: int) -> Failure | None:
        """One try: None, or the end that it leads to unless it is repeated."""
        self._tries = attempt
        met, self._met = self._met, None
        started, begun = self.clock.now(), time.monotonic()
        deadline = started + step.deadline_s * (self.clock.rate if step.on_wall else 1.0)
        context = StepContext(
            step,
            attempt,
            deadline,
            dict(self._results),
            self.clock,
            self._teller.tell,
            self.control,
            self._watchman.waiting.look,
        )
        key = self.journal.step_started(step.name, attempt)
        self._teller.tell(Event("step_started", step.name, {"attempt": attempt}))
        self._watchman.error = None
        call, end = self._watchman.watch(
            step.name, lambda: self._begin(context, met), deadline, context.token, ailing=True
        )
        context.token.cancel(f"{step.name} has ended")
        if end is None and call.error is not None:
            self._watchman.error = call.error
            # At rest before anything is read or written: a disk may stall.
            stopped = f"{step.name} failed"
            trouble = self._watchman.halt(stopped)
            end = self._watchman.asked() or self._watchman.judge(call.error)
            self._teller.stopped(stopped, trouble)
        duration = self.clock.now() - started
        before = self._records[step.name]
        wall = before.wall_s + time.monotonic() - begun
        state = "done" if end is None else "failed"
        retries = before.retries + (attempt > 1)
        self._records[step.name] = StepRecord(step.name, state, before.duration_s + duration, retries, wall)
        if end is not None:
            self.journal.step_ended(key, duration, error=end.reason)
            self._teller.tell(Event("step_failed", step.name, {"attempt": attempt, "reason": end.reason}))
            return end
        summary = summary_of(call.result) or {}
        self._results[step.name] = call.result
        self.journal.step_ended(key, duration, summary)
        self._teller.tell(Event("step_done", step.name, {"duration_s": duration, **summary}))
        return None

    def _begin(self, context: StepContext, met: Exception | None) -> object:
        """A step's work, in a cell that is well; what was `met` while the run was held fails the attempt here."""
        if met is not None:
            raise met
        if self.health is not None:
            self.health()
        return self.steps[context.step.name](context)

    # --- the end ---

    def _finish(self, end: Failure | None) -> RunResult:
        outcome = Outcome(self.sequence.success.value) if end is None else end.outcome
        reason = f"end of the run ({outcome.value})"
        # Whoever still works in an abandoned thread begins nothing any more.
        self.control.over = True
        if not self.control.token.cancel("the run has ended") and end is None:
            self.control.late = True
        trouble = self._watchman.halt(reason)
        said = "all steps done" if end is None else end.reason
        if trouble is not None:
            end = Failure(Outcome.FAULTED, f"{said}; the safe stop failed: {trouble}", "safe_stop")
        try:
            if trouble is not None and end is not None:
                self._teller.failed("", 0, end, "ended the run")
            self._teller.stopped(reason, trouble)
            if end is not None:
                self.sequence.fire(_END_TRIGGERS[end.outcome])
                outcome, said = end.outcome, end.reason
            self.journal.run_ended(outcome.value, said)
        except (JournalError, SequenceError) as error:
            outcome = Outcome.FAULTED
            end = Failure(outcome, f"{said}; the end could not be recorded: {error}", "run.internal")
            said = end.reason
        self._teller.tell(Event("run_ended", None, {"outcome": outcome.value, "reason": said}))
        records = tuple(self._records[name] for name in self.sequence.steps)
        code = "" if end is None else end.code
        return RunResult(
            outcome,
            said,
            code,
            records,
            dict(self._results),
            self._watchman.error,
            self.control.signal,
            tuple(self._teller.faults),
        )
