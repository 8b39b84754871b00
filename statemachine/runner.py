"""Drives a sequence of steps to its end, whatever happens, and ends it safe.

The runner has the steps watched, repeats what the policy lets it repeat, and writes everything to the journal. It knows
neither devices nor the cell: `classify` judges exceptions, `safe_stop` brings the cell to rest. A script may look at
results between the steps, and decide on a refusal.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from statemachine.attempts import Attempts, Recover, performed
from statemachine.control import CancelToken, RunControl
from statemachine.journal import Journal, JournalError
from statemachine.sequence import JobTrigger, Sequence, SequenceError
from statemachine.step import (
    Event,
    Failure,
    FaultRecord,
    Observer,
    Outcome,
    Policy,
    RunResult,
    StepCall,
    StepContext,
    StepRecord,
)
from statemachine.waiting import waiting_on
from statemachine.watch import RunClock, SignalWatch
from statemachine.watchman import EventLog, Watchman


@dataclass(frozen=True)
class Again:
    """The decision to go on from a step, that was refused or an earlier one, and why, for the journal."""

    step: str
    why: str


@dataclass(frozen=True)
class Script:
    """`after` maps a step's name to what is called with its result before the next step begins; what it raises ends
    the run as if the step had raised it. `on_refusal` is called with the name of the step that was refused and the
    failure: it gives `Again`, or None to let the run end; after `most` decisions about one step the run ends without
    asking. Both run with the cell at rest, for as long as they like."""

    after: Mapping[str, Callable[[object], None]] = field(default_factory=dict)
    on_refusal: Callable[[str, Failure], Again | None] | None = None
    most: int = 3

    @property
    def idle(self) -> bool:
        """Whether it does nothing at all."""
        return not self.after and self.on_refusal is None


NO_SCRIPT = Script()
"""Nobody looks between the steps, and a refusal ends the run."""


class Scripting:
    """The script of one run at work; it counts what was decided about each step."""

    def __init__(self, script: Script, steps: tuple[str, ...], watchman: Watchman) -> None:
        self._script = script
        self._steps = steps
        self._watchman = watchman
        self._decisions: Counter[str] = Counter()

    def after(self, name: str, result: object) -> Failure | None:
        """What the script does with the result of a step: why that ends the run, or None."""
        if (check := self._script.after.get(name)) is None:
            return None
        return self._do(name, lambda: check(result))[0]

    def decide(self, name: str, end: Failure) -> Failure | Again:
        """Ask the script about a refusal: a step from which the run goes on, up to the refused one, or why it ends."""
        decide = self._script.on_refusal
        if decide is None or end.outcome is not Outcome.REFUSED:
            return end
        if self._decisions[name] >= self._script.most:
            text = f"{end.reason}; the script has decided about {name} {self._script.most} times, the most allowed"
            return replace(end, reason=text)
        self._decisions[name] += 1
        failed, chosen = self._do(name, lambda: decide(name, end))
        if failed is not None or not isinstance(chosen, Again):
            return failed or end
        allowed = self._steps[: self._steps.index(name) + 1]
        if chosen.step not in allowed:
            text = f"{end.reason}; the script chose to go on from {chosen.step!r}, allowed: {', '.join(allowed)}"
            return replace(end, reason=text)
        return chosen

    def _do(self, name: str, work: Callable[[], object]) -> tuple[Failure | None, object]:
        """Do what the script does after a step: why that ended the run, or None, and what it gave."""
        token = CancelToken(self._watchman.control.token)
        call, end = self._watchman.watch(f"the script after {name}", work, math.inf, token, ailing=True)
        if end is None and call.error is not None:
            self._watchman.error = call.error
            end = self._watchman.asked() or self._watchman.judge(call.error)
        return end, call.result


__all__ = ["Event", "FaultRecord", "RunResult", "Runner", "StepContext", "StepRecord"]

_END_TRIGGERS = {
    Outcome.REFUSED: JobTrigger.REFUSE,
    Outcome.MISPLACED: JobTrigger.MISPLACE,
    Outcome.FAULTED: JobTrigger.FAULT,
    Outcome.ABORTED: JobTrigger.ABORT,
}


@dataclass(frozen=True)
class LoneResult:
    """What a step made that was done alone, or the `end` it came to.

    `error` is the exception behind the end, and `judged` what that means by itself. `abandoned` says that the step is
    still busy after its stop, `unrecorded` why its end is not in the journal.
    """

    made: object
    end: Failure | None
    error: BaseException | None
    judged: Failure | None
    abandoned: bool
    unrecorded: JournalError | None


@dataclass
class Runner:
    """Runs one job, or one step alone. Either is called once; what a person or another program asks comes through
    `control`.

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
    _events: EventLog = field(init=False)
    _attempts: Attempts = field(init=False)

    def __post_init__(self) -> None:
        missing = [name for name in self.sequence.steps if name not in self.steps]
        if missing:
            raise ValueError(f"no work was given for {', '.join(missing)}")

    def run(self) -> RunResult:
        """Do the steps and return how it ended. Raises nothing: every exception of a step, of the journal or of the
        runner itself becomes an outcome, after the safe stop."""
        with self._watching():
            self.sequence.on_change = self._events.changed
            try:
                end = self._drive()
            except Exception as error:
                self._watchman.error = error
                end = Failure(Outcome.FAULTED, f"the run could not go on: {error}", "run.internal")
            return self._finish(end)

    def run_alone(self) -> LoneResult:
        """Do the only step, within a run that others begin and end, and may go on with.

        The cell is brought to rest where the step failed or somebody asks for the end; otherwise it is left as it is.
        Raises nothing that the step or the journal raises.
        """
        (name,) = self.sequence.steps
        with self._watching():
            watchman, attempts = self._watchman, self._attempts
            end: Failure | None = None
            unrecorded: JournalError | None = None
            self.sequence.fire(JobTrigger.START)
            try:
                end = performed(self.policy.of(name), attempts, self.recover, self.sequence, watchman=watchman)
                end = end or watchman.asked()
            # Its end cannot be recorded; what it ended with counts.
            except JournalError as failure:
                unrecorded = failure
                if name not in attempts.results:
                    watchman.error = watchman.error or failure
                    end = Failure(Outcome.FAULTED, str(watchman.error))
            if end is not None and not watchman.at_rest:
                watchman.halt(end.reason)
            error = watchman.error
            judged = None if error is None else watchman.classified(error)
            return LoneResult(attempts.results.get(name), end, error, judged, watchman.abandoned, unrecorded=unrecorded)

    @contextmanager
    def _watching(self) -> Iterator[None]:
        """Set up what watches, for a whole run and for a step alone."""
        self._events = EventLog(self.journal, self.observer, lambda: str(self.sequence.state))
        with SignalWatch() as signals:
            self._watchman = Watchman(
                policy=self.policy, journal=self.journal, clock=self.clock, control=self.control,
                classify=self.classify, safe_stop=self.safe_stop, health=self.health, waiting=waiting_on(self.clock),
                signals=signals, events=self._events,
            )  # fmt: skip
            self._attempts = Attempts(self.sequence.steps, self.steps, self._watchman)
            yield

    def _drive(self) -> Failure | None:
        """Walk through the steps; None when all are done, else why not."""
        if (end := self._watchman.asked()) is not None:
            return end
        attempts = self._attempts
        script = Scripting(self.script, self.sequence.steps, self._watchman)
        self.sequence.fire(JobTrigger.START)
        while (state := self.sequence.state) in self.sequence.steps:
            attempts.tries = 1
            step = self.policy.of(state)
            end = (
                self._hold()
                or performed(step, attempts, self.recover, self.sequence, watchman=self._watchman, hold=self._hold)
                or script.after(state, attempts.results.get(state))
            )
            if end is None:
                self.sequence.facts.done.add(state)
                self.sequence.fire(JobTrigger.NEXT)
                continue
            decided = script.decide(state, end)
            end = self._go_back(state, end, decided) if isinstance(decided, Again) else decided
            if end is not None:
                self._events.failed(state, attempts.tries, end, "ended the run")
                return end
        return None

    def _hold(self) -> Failure | None:
        """Stay here while the run is paused: why it is to end, or None. What ails the cell then fails the next try."""
        watchman, attempts = self._watchman, self._attempts
        end, attempts.met = watchman.asked(), None
        if end is not None or not self.control.paused():
            return end
        step = self.sequence.state
        self.sequence.fire(JobTrigger.PAUSE)
        self._events.notify(Event("paused", step, {"text": f"held before {step}"}))
        with self.control.held():
            while end is None and self.control.paused() and attempts.met is None:
                end = watchman.wait_briefly()
                attempts.met = watchman.examine()
        if end is None:
            self.sequence.fire(JobTrigger.RESUME)
            text = "goes on" if attempts.met is None else f"held no longer: {attempts.met}"
            self._events.notify(Event("going_on", step, {"text": text}))
        return end

    def _go_back(self, name: str, end: Failure, chosen: Again) -> Failure | None:
        """Go on from the step that the script chose after the end of step `name`; why that ends the run, or None."""
        if (unsafe := self._watchman.halt_before(f"before {chosen.step} is done again", end)) is not None:
            return unsafe
        self._events.failed(name, self._attempts.tries, end, f"again from {chosen.step}")
        self._events.notify(Event("decided", name, {"reason": end.reason, "again": chosen.step, "why": chosen.why}))
        self._attempts.forget_from(chosen.step)
        self.sequence.facts.chosen = chosen.step
        self.sequence.fire(JobTrigger.AGAIN)
        return None

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
                self._events.failed("", 0, end, "ended the run")
            self._events.stopped(reason, trouble)
            # Who asked since the last look was told that the run was asked.
            self.control.obey(self.journal.take_requests())
            if end is not None:
                self.sequence.fire(_END_TRIGGERS[end.outcome])
                outcome, said = end.outcome, end.reason
            self.journal.run_ended(outcome.value, said)
        except (JournalError, SequenceError) as error:
            outcome = Outcome.FAULTED
            end = Failure(outcome, f"{said}; the end could not be recorded: {error}", "run.internal")
            said = end.reason
        self._events.notify(Event("run_ended", None, {"outcome": outcome.value, "reason": said}))
        code = "" if end is None else end.code
        return RunResult(
            outcome, said, code, steps=tuple(self._attempts.records[name] for name in self.sequence.steps),
            results=dict(self._attempts.results), error=self._watchman.error, signal=self.control.signal,
            faults=tuple(self._events.faults),
        )  # fmt: skip
