"""Doing a step until it succeeds: one try after the other, recovering from faults, and what a run waits for."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

from statemachine.control import CancelToken
from statemachine.sequence import JobTrigger, Sequence
from statemachine.step import Event, Failure, OnFailure, Outcome, Step, StepCall, StepContext, StepRecord, summary_of
from statemachine.watchman import Watchman


class Attempts:
    """The steps' work, done one try at a time under watch.

    `records` are how the steps went and `results` what they made, by their names; `tries` is the number of the newest
    try at its step. `met` is what ailed the cell while the run was held: it fails the next try.
    """

    def __init__(self, names: tuple[str, ...], steps: Mapping[str, StepCall], watchman: Watchman) -> None:
        """`steps` has the work of each of the `names`."""
        self.records = {name: StepRecord(name) for name in names}
        self.results: dict[str, object] = {}
        self.tries = 1
        self.met: Exception | None = None
        self._steps = steps
        self._watchman = watchman

    def forget_from(self, name: str) -> None:
        """This step and all after it are to be done again."""
        names = list(self.records)
        for later in names[names.index(name) :]:
            self.results.pop(later, None)
            self.records[later] = replace(self.records[later], state="open")

    def attempt(self, step: Step, number: int) -> Failure | None:
        """Try a step for the time of this number: None, or the end that it leads to unless it is repeated."""
        watchman, clock, events = self._watchman, self._watchman.clock, self._watchman.events
        self.tries = number
        met, self.met = self.met, None
        started, begun = clock.now(), time.monotonic()
        deadline = started + step.deadline_s * (clock.rate if step.on_wall else 1.0)
        context = StepContext(
            step, number, deadline, results=dict(self.results), clock=clock, notify=events.notify,
            control=watchman.control, check=watchman.waiting.check,
        )  # fmt: skip
        key = watchman.journal.step_started(step.name, number)
        events.notify(Event("step_started", step.name, {"attempt": number}))
        watchman.error = None
        call, end = watchman.watch(step.name, lambda: self._begin(context, met), deadline, context.token, ailing=True)
        context.token.cancel(f"{step.name} has ended")
        if end is None and call.error is not None:
            watchman.error = call.error
            # At rest before anything is read or written: a disk may stall.
            stopped = f"{step.name} failed"
            trouble = watchman.halt(stopped)
            end = watchman.asked() or watchman.judge(call.error)
            events.stopped(stopped, trouble)
        duration = clock.now() - started
        before = self.records[step.name]
        wall = before.wall_s + time.monotonic() - begun
        state = "done" if end is None else "failed"
        retries = before.retries + (number > 1)
        self.records[step.name] = StepRecord(step.name, state, before.duration_s + duration, retries, wall)
        if end is not None:
            watchman.journal.step_ended(key, duration, error=end.reason)
            events.notify(Event("step_failed", step.name, {"attempt": number, "reason": end.reason}))
            return end
        summary = summary_of(call.result) or {}
        self.results[step.name] = call.result
        watchman.journal.step_ended(key, duration, summary)
        events.notify(Event("step_done", step.name, {"duration_s": duration, **summary}))
        return None

    def _begin(self, context: StepContext, met: Exception | None) -> object:
        """A step's work, in a cell that is well; what was `met` while the run was held fails the attempt here."""
        if met is not None:
            raise met
        if self._watchman.health is not None:
            self._watchman.health()
        return self._steps[context.step.name](context)


def await_word(step: Step, end: Failure, watchman: Watchman) -> tuple[Failure | None, str | None]:
    """Wait until a person has confirmed the fault `end`: why that ended the run, or None; and who it was. A fault that
    no recovery can clear, such as an emergency stop, ends the wait and the run."""
    policy, control, notify = watchman.policy, watchman.control, watchman.events.notify
    if policy.simulated_person:
        by = "the simulated person"
    else:
        number = control.ask(end.reason)
        notify(Event("confirm_needed", step.name, {"reason": end.reason, "code": end.code, "number": number}))
        try:
            until = time.monotonic() + policy.confirm_deadline_s
            while (found := control.answer()) is None:
                if (worse := watchman.wait_briefly() or _worse(watchman)) is not None:
                    return worse, None
                if time.monotonic() > until:
                    text = f"{end.reason}; nobody confirmed within {policy.confirm_deadline_s:g} s"
                    return replace(end, outcome=Outcome.FAULTED, reason=text), None
            by = found
        finally:
            control.asked_no_more()
    notify(Event("confirmed", step.name, {"by": by, "reason": end.reason}))
    return None, by


def _worse(watchman: Watchman) -> Failure | None:
    """What ails the cell and no recovery can clear; the fault that a person is asked about can be cleared."""
    if (error := watchman.examine()) is None or watchman.classified(error).recoverable:
        return None
    watchman.error = error
    return watchman.judge(error)


Recover = Callable[[BaseException, CancelToken, bool], None]
"""Clears the fault behind an exception, begins nothing once the token is cancelled; told whether a person confirmed."""


def performed(
    step: Step, attempts: Attempts, recover: Recover | None, sequence: Sequence, watchman: Watchman,
    hold: Callable[[], Failure | None] = lambda: None,
) -> Failure | None:  # fmt: skip
    """Do one step, with its repetitions; None when it has succeeded. `hold()` waits while the run is paused."""
    attempt = 1
    while (end := attempts.attempt(step, attempt)) is not None:
        left = step.max_retries + 1 - attempt
        error = watchman.error
        if left == 0 or error is None or watchman.abandoned or end.outcome is Outcome.ABORTED:
            return end
        sequence.facts.retries_left = left
        sequence.facts.recoverable = end.recoverable
        if step.retries(error):
            if (unsafe := watchman.halt_before(f"before {step.name} is tried again", end)) is not None:
                return unsafe
            watchman.events.failed(step.name, attempt, end, "tried again")
            sequence.fire(JobTrigger.RETRY)
        elif end.recoverable and step.on_failure is OnFailure.RECOVER and recover is not None:
            failed, by = recovered(step, end, error, recover=recover, sequence=sequence, watchman=watchman)
            if failed is not None:
                return failed
            watchman.events.failed(step.name, attempt, end, f"confirmed by {by}, recovered" if by else "recovered")
        else:
            return end
        if (asked := hold()) is not None:
            return asked
        attempt += 1
    return None


def recovered(
    step: Step, end: Failure, error: BaseException, recover: Recover, sequence: Sequence, watchman: Watchman
) -> tuple[Failure | None, str | None]:
    """Clear the fault `end` of a step: why that ended the run, or None; and who has confirmed it, where needed."""
    sequence.fire(JobTrigger.FAULT)
    # The failed attempt was stopped already. A device that is to be recovered may not have confirmed it; after the
    # recovery all have to.
    by = None
    if end.needs_person:
        refused, by = await_word(step, end, watchman)
        if refused is not None:
            return refused, None
    sequence.fire(JobTrigger.RECOVER)
    token = CancelToken(watchman.control.token)
    deadline = watchman.clock.now() + watchman.policy.recovery_deadline_s
    call, failed = watchman.watch("the recovery", lambda: recover(error, token, by is not None), deadline, token)
    if failed is None and call.error is not None:
        watchman.error = call.error
        failed = watchman.asked()
    if failed is None and call.error is not None:
        judged = watchman.judge(call.error)
        failed = replace(judged, outcome=Outcome.FAULTED, reason=f"{error}; the recovery failed: {judged.reason}")
    if failed is None:
        failed = watchman.halt_before(f"recovered, before {step.name} is tried again", end)
    if failed is None:
        sequence.fire(JobTrigger.RECOVERED)
    return failed, by
