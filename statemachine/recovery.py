"""Doing a step until it succeeds: repeating it, and clearing faults meanwhile, confirmed by a person where needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from statemachine.attempts import Attempts
from statemachine.cancel import CancelToken
from statemachine.policy import Failure, OnFailure, Outcome, Step
from statemachine.sequence import JobTrigger, Sequence
from statemachine.standing import await_word
from statemachine.watchman import Watchman

Recover = Callable[[BaseException, CancelToken, bool], None]
"""Clears the fault behind an exception, begins nothing once the token is cancelled; told whether a person confirmed."""


def performed(
    step: Step,
    attempts: Attempts,
    recover: Recover | None,
    sequence: Sequence,
    watchman: Watchman,
    hold: Callable[[], Failure | None] = lambda: None,
) -> Failure | None:
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
            watchman.teller.failed(step.name, attempt, end, "tried again")
            sequence.fire(JobTrigger.RETRY)
        elif end.recoverable and step.on_failure is OnFailure.RECOVER and recover is not None:
            failed, by = recovered(step, end, error, recover=recover, sequence=sequence, watchman=watchman)
            if failed is not None:
                return failed
            watchman.teller.failed(step.name, attempt, end, f"confirmed by {by}, recovered" if by else "recovered")
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
