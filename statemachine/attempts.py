"""One try at a step, from its row in the journal to its result; and what came of all tries so far."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

from statemachine.policy import Failure, Step
from statemachine.step import Event, StepCall, StepContext, StepRecord, summary_of
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

    def resume(self, name: str, result: object) -> None:
        """A step was done in an earlier run."""
        self.results[name] = result
        self.records[name] = StepRecord(name, "resumed")

    def forget_from(self, name: str) -> None:
        """This step and all after it are to be done again."""
        names = list(self.records)
        for later in names[names.index(name) :]:
            self.results.pop(later, None)
            self.records[later] = replace(self.records[later], state="open")

    def attempt(self, step: Step, number: int) -> Failure | None:
        """Try a step for the time of this number: None, or the end that it leads to unless it is repeated."""
        watchman, clock, teller = self._watchman, self._watchman.clock, self._watchman.teller
        self.tries = number
        met, self.met = self.met, None
        started, begun = clock.now(), time.monotonic()
        deadline = started + step.deadline_s * (clock.rate if step.on_wall else 1.0)
        context = StepContext(
            step,
            number,
            deadline,
            results=dict(self.results),
            clock=clock,
            tell=teller.tell,
            control=watchman.control,
            look=watchman.waiting.look,
        )
        key = watchman.journal.step_started(step.name, number)
        teller.tell(Event("step_started", step.name, {"attempt": number}))
        watchman.error = None
        call, end = watchman.watch(step.name, lambda: self._begin(context, met), deadline, context.token, ailing=True)
        context.token.cancel(f"{step.name} has ended")
        if end is None and call.error is not None:
            watchman.error = call.error
            # At rest before anything is read or written: a disk may stall.
            stopped = f"{step.name} failed"
            trouble = watchman.halt(stopped)
            end = watchman.asked() or watchman.judge(call.error)
            teller.stopped(stopped, trouble)
        duration = clock.now() - started
        before = self.records[step.name]
        wall = before.wall_s + time.monotonic() - begun
        state = "done" if end is None else "failed"
        retries = before.retries + (number > 1)
        self.records[step.name] = StepRecord(step.name, state, before.duration_s + duration, retries, wall)
        if end is not None:
            watchman.journal.step_ended(key, duration, error=end.reason)
            teller.tell(Event("step_failed", step.name, {"attempt": number, "reason": end.reason}))
            return end
        summary = summary_of(call.result) or {}
        self.results[step.name] = call.result
        watchman.journal.step_ended(key, duration, summary)
        teller.tell(Event("step_done", step.name, {"duration_s": duration, **summary}))
        return None

    def _begin(self, context: StepContext, met: Exception | None) -> object:
        """A step's work, in a cell that is well; what was `met` while the run was held fails the attempt here."""
        if met is not None:
            raise met
        if self._watchman.health is not None:
            self._watchman.health()
        return self._steps[context.step.name](context)
