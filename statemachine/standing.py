"""What a run waits for while the cell stands: that it goes on after a pause, and a person's word after a fault."""

from __future__ import annotations

import time
from dataclasses import replace

from statemachine.policy import Failure, Outcome, Step
from statemachine.sequence import JobTrigger, Sequence
from statemachine.step import Event
from statemachine.watchman import Watchman


def hold(sequence: Sequence, watchman: Watchman) -> tuple[Failure | None, Exception | None]:
    """Stay paused for as long as it is asked for and the cell is well.

    Why the run is to end, or None; and what ails the cell, which fails the next attempt.
    """
    end, ailment = watchman.asked(), None
    control, tell = watchman.control, watchman.teller.tell
    if end is None and control.paused():
        step = sequence.state
        sequence.fire(JobTrigger.PAUSE)
        tell(Event("paused", step, {"text": f"held before {step}"}))
        while end is None and control.paused() and ailment is None:
            end = watchman.wait_briefly()
            ailment = watchman.examine()
        if end is None:
            sequence.fire(JobTrigger.RESUME)
            text = "goes on" if ailment is None else f"held no longer: {ailment}"
            tell(Event("going_on", step, {"text": text}))
    return end, ailment


def await_word(step: Step, end: Failure, watchman: Watchman) -> tuple[Failure | None, str | None]:
    """Wait until a person has confirmed the fault `end`: why that ended the run, or None; and who it was.

    A fault that no recovery can clear, such as an emergency stop, ends the wait and the run.
    """
    policy, control, tell = watchman.policy, watchman.control, watchman.teller.tell
    if policy.simulated_person:
        by = "the simulated person"
    else:
        number = control.ask(end.reason)
        tell(Event("confirm_needed", step.name, {"reason": end.reason, "code": end.code, "number": number}))
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
    tell(Event("confirmed", step.name, {"by": by, "reason": end.reason}))
    return None, by


def _worse(watchman: Watchman) -> Failure | None:
    """What ails the cell and no recovery can clear; the fault that a person is asked about can be cleared."""
    if (error := watchman.examine()) is None or watchman.classified(error).recoverable:
        return None
    watchman.error = error
    return watchman.judge(error)
