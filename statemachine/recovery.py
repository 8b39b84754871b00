"""Clearing a fault while the cell stands, once a person has confirmed it where that is needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from statemachine.cancel import CancelToken
from statemachine.policy import Failure, Outcome, Step
from statemachine.sequence import Sequence, Trigger
from statemachine.standing import await_word
from statemachine.watchman import Watchman

Recover = Callable[[BaseException, CancelToken, bool], None]
"""Clears the fault behind an exception, begins nothing once the token is cancelled; told whether a person confirmed."""


def recovered(
    step: Step, end: Failure, error: BaseException, recover: Recover, sequence: Sequence, watchman: Watchman
) -> tuple[Failure | None, str | None]:
    """Clear the fault `end` of a step: why that ended the run, or None; and who has confirmed it, where needed."""
    sequence.fire(Trigger.FAULT)
    # The failed attempt was stopped already. A device that is to be recovered may not have confirmed it; after the
    # recovery all have to.
    by = None
    if end.needs_person:
        refused, by = await_word(step, end, watchman)
        if refused is not None:
            return refused, None
    sequence.fire(Trigger.RECOVER)
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
        sequence.fire(Trigger.RECOVERED)
    return failed, by
