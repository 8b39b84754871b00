"""What passes between the runner and the steps: the context a step is given, events, and records of how it went."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from statemachine.policy import Outcome, Step
from statemachine.watch import Clock


class StepOverrun(RuntimeError):
    """A step did not end within its deadline. A policy can name it in `retry_on`."""


class StepCancelled(RuntimeError):
    """Raised by `StepContext.check` in a step that is to end now."""


@runtime_checkable
class Summarised(Protocol):
    """A step's result that has something to say for the journal."""

    def summary(self) -> Mapping[str, object]:
        """JSON-ready figures."""


@dataclass(frozen=True)
class Event:
    """What an observer is told: `kind` is state, step_started, step_done, step_failed, progress, safe_stop or note."""

    kind: str
    step: str | None
    data: Mapping[str, object]


Observer = Callable[[Event], None]


class StepContext:
    """What a step is given: earlier results, its deadline, and ways to report.

    `results` maps the earlier steps' names to what they returned. `deadline` is in seconds of the cell's clock.
    """

    def __init__(
        self, step: Step, attempt: int, deadline: float, results: Mapping[str, object], clock: Clock, tell: Observer
    ) -> None:
        self.step = step
        self.attempt = attempt
        self.deadline = deadline
        self.results = results
        self._clock = clock
        self._tell = tell
        self._cancelled: str | None = None

    def remaining(self) -> float:
        """Seconds of the cell's clock until the deadline, at least 0."""
        return max(0.0, self.deadline - self._clock.now())

    def check(self) -> None:
        """Raise `StepCancelled` if the step is to end now. For loops that wait for no device."""
        if self._cancelled is not None:
            raise StepCancelled(self._cancelled)

    def progress(self, fraction: float, text: str = "") -> None:
        """Tell the observer how far the step is, 0 to 1; not written to the journal. Raises like `check`."""
        self.check()
        self._tell(Event("progress", self.step.name, {"fraction": fraction, "text": text}))

    def note(self, **data: object) -> None:
        """Write something worth keeping to the journal and tell the observer."""
        self._tell(Event("note", self.step.name, data))

    def cancel(self, reason: str) -> None:
        """Let `check` raise from now on."""
        self._cancelled = reason


@dataclass(frozen=True)
class StepRecord:
    """How one step went; `state` is open, done, failed or resumed. `duration_s` sums all attempts, in cell seconds."""

    name: str
    state: str = "open"
    duration_s: float = 0.0
    retries: int = 0


@dataclass(frozen=True)
class RunResult:
    """How a run ended. `signal` is the number of the signal that ended it; `error` the exception behind the end."""

    outcome: Outcome
    reason: str
    code: str
    steps: tuple[StepRecord, ...]
    results: Mapping[str, object]
    error: BaseException | None = None
    signal: int | None = None


StepCall = Callable[[StepContext], object]
"""A step's work: takes its context and returns what it made."""
