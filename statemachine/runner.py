"""Drives a sequence of steps to its end, whatever happens, and ends it safe.

The work is done by the steps that are passed in. The runner has them watched (`statemachine.watchman`), repeats what
the policy lets it repeat, and writes everything to the journal as it happens. It knows neither devices nor the cell:
exceptions are judged by `classify`, the cell is brought to rest by `safe_stop`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from statemachine.attempts import Attempts
from statemachine.control import RunControl
from statemachine.journal import Journal, JournalError
from statemachine.policy import Failure, Outcome, Policy, Step
from statemachine.recovery import Recover, performed
from statemachine.script import NO_SCRIPT, Again, Script, Scripting
from statemachine.sequence import JobTrigger, Sequence, SequenceError
from statemachine.standing import hold
from statemachine.step import Event, FaultRecord, Observer, RunResult, StepCall, StepContext, StepRecord
from statemachine.telling import Teller
from statemachine.waiting import waiting_on
from statemachine.watch import RunClock, SignalWatch
from statemachine.watchman import Watchman

__all__ = ["Event", "FaultRecord", "RunResult", "Runner", "StepContext", "StepRecord"]

_END_TRIGGERS = {
    Outcome.REFUSED: JobTrigger.REFUSE,
    Outcome.FAULTED: JobTrigger.FAULT,
    Outcome.ABORTED: JobTrigger.ABORT,
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
    clock: RunClock
    classify: Callable[[BaseException], Failure]
    safe_stop: Callable[[str], None]
    observer: Observer | None = None
    recover: Recover | None = None
    health: Callable[[], None] | None = None
    control: RunControl = field(default_factory=RunControl)
    script: Script = NO_SCRIPT
    _watchman: Watchman = field(init=False)
    _teller: Teller = field(init=False)
    _attempts: Attempts = field(init=False)

    def __post_init__(self) -> None:
        missing = [name for name in self.sequence.steps if name not in self.steps]
        if missing:
            raise ValueError(f"no work was given for {', '.join(missing)}")

    def run(self, done: Mapping[str, object] | None = None) -> RunResult:
        """Do the steps that are not in `done` (results of an earlier run by step name) and return how it ended.

        Raises nothing: every exception of a step, of the journal or of the runner itself becomes an outcome, after
        the safe stop.
        """
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
            self._attempts = Attempts(self.sequence.steps, self.steps, self._watchman)
            for name, result in (done or {}).items():
                self.sequence.facts.done.add(name)
                self._attempts.resume(name, result)
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
        attempts = self._attempts
        script = Scripting(self.script, self.sequence.steps, self._watchman)
        self.sequence.fire(JobTrigger.START)
        while (state := self.sequence.state) in self.sequence.steps:
            attempts.tries = 1
            end = (
                self._hold() or self._perform(self.policy.of(state)) or script.after(state, attempts.results.get(state))
            )
            if end is None:
                self.sequence.facts.done.add(state)
                self.sequence.fire(JobTrigger.NEXT)
                continue
            decided = script.decide(state, end)
            end = self._go_back(state, end, decided) if isinstance(decided, Again) else decided
            if end is not None:
                self._teller.failed(state, attempts.tries, end, "ended the run")
                return end
        return None

    def _hold(self) -> Failure | None:
        """Stay here while the run is paused; what ails the cell meanwhile fails the next attempt."""
        end, self._attempts.met = hold(self.sequence, self._watchman)
        return end

    def _go_back(self, name: str, end: Failure, chosen: Again) -> Failure | None:
        """Go on from the step that the script chose after the end of step `name`; why that ends the run, or None."""
        if (unsafe := self._watchman.halt_before(f"before {chosen.step} is done again", end)) is not None:
            return unsafe
        self._teller.failed(name, self._attempts.tries, end, f"again from {chosen.step}")
        self._teller.tell(Event("decided", name, {"reason": end.reason, "again": chosen.step, "why": chosen.why}))
        self._attempts.forget_from(chosen.step)
        self.sequence.facts.chosen = chosen.step
        self.sequence.fire(JobTrigger.AGAIN)
        return None

    def _perform(self, step: Step) -> Failure | None:
        """Do one step, with its repetitions; None when it has succeeded."""
        return performed(step, self._attempts, self.recover, self.sequence, watchman=self._watchman, hold=self._hold)

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
        code = "" if end is None else end.code
        return RunResult(
            outcome,
            said,
            code,
            steps=tuple(self._attempts.records[name] for name in self.sequence.steps),
            results=dict(self._attempts.results),
            error=self._watchman.error,
            signal=self.control.signal,
            faults=tuple(self._teller.faults),
        )
