"""What passes between the runner and the steps: context, policy, events, and records of how it went.

A policy names exceptions by their class names, so that it imports nothing that raises them. A failure is looked at in
this order: an end that was asked for; a retry; a recovery; the end of the run.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol, TypeVar, runtime_checkable

from statemachine.control import CancelToken, RunControl
from statemachine.watch import RunClock


class Outcome(Enum):
    """How a run ended: done where nothing is placed, misplaced where the placed part was seen out of its place."""

    PLACED = "placed"
    DONE = "done"
    REFUSED = "refused"
    MISPLACED = "misplaced"
    FAULTED = "faulted"
    ABORTED = "aborted"


@dataclass(frozen=True)
class Failure:
    """Why a step did not succeed: the outcome it leads to unless it is repeated, and the reason in words.

    `code` is short and stable, for scripts. `recoverable` says that a recovery can clear it; `needs_person` that a
    person has to look and confirm before that. `error` is the exception behind it, for whoever decides.
    """

    outcome: Outcome
    reason: str
    code: str = ""
    recoverable: bool = False
    needs_person: bool = False
    error: BaseException | None = field(default=None, compare=False, repr=False)


class OnFailure(Enum):
    """What is done about a failure that is not simply retried."""

    STOP = "stop"
    RECOVER = "recover"


@dataclass(frozen=True)
class Step:
    """How one step is watched.

    `deadline_s` is in seconds of the cell's clock; for a step that only computes, set `on_wall`: it then counts on the
    wall, because a simulated cell that runs faster does not compute faster. The step is tried again at most
    `max_retries` times: at once if the class of its exception, or a base of it, is named in `retry_on`; after a
    recovery if the failure is recoverable and `on_failure` says so.
    """

    name: str
    deadline_s: float
    max_retries: int = 0
    retry_on: tuple[str, ...] = ()
    on_failure: OnFailure = OnFailure.RECOVER
    on_wall: bool = False

    def __post_init__(self) -> None:
        if not self.deadline_s > 0:
            raise ValueError(f"step '{self.name}': deadline {self.deadline_s} s must be greater than 0 s")
        if self.max_retries < 0:
            raise ValueError(f"step '{self.name}': max_retries {self.max_retries} must be 0 or more")

    def retries(self, error: BaseException) -> bool:
        """Whether this exception is one that the step is simply tried again after."""
        return any(base.__name__ in self.retry_on for base in type(error).__mro__)


@dataclass(frozen=True)
class Policy:
    """The steps' policies in the steps' order, and the time that stopping, ending and recovering may take.

    `stop_deadline_s` bounds one safe stop and `grace_s` the time that a step has to end after it was stopped, both in
    seconds on the wall; `recovery_deadline_s` bounds a recovery, in seconds of the cell's clock. A run that needs a
    person's word waits `confirm_deadline_s` on the wall; with `simulated_person` it is given at once, for a simulated
    cell, where nobody can be hurt.
    """

    steps: tuple[Step, ...]
    stop_deadline_s: float = 10.0
    grace_s: float = 5.0
    recovery_deadline_s: float = 60.0
    confirm_deadline_s: float = 1800.0
    simulated_person: bool = False

    def __post_init__(self) -> None:
        names = [step.name for step in self.steps]
        if len(names) != len(set(names)):
            raise ValueError(f"a policy names each step once, given: {names}")

    def of(self, name: str) -> Step:
        """The policy of the step of this name."""
        return next(step for step in self.steps if step.name == name)


Made = TypeVar("Made")


class StepOverrun(RuntimeError):
    """A step did not end within its deadline. A policy can name it in `retry_on`."""


@runtime_checkable
class Summarised(Protocol):
    """A step's result that has something to say for the journal."""

    def summary(self) -> Mapping[str, object]:
        """JSON-ready figures."""


def summary_of(made: object) -> dict[str, object] | None:
    """What a step's result says for the journal and the report, None when it has nothing to say. One whose summary
    fails says why: the step is done all the same."""
    if not isinstance(made, Summarised):
        return None
    try:
        return {str(key): value for key, value in made.summary().items()}
    except Exception as error:
        return {"summary_missing": f"{type(error).__name__}: {error}"}


@dataclass(frozen=True)
class Event:
    """What an observer is told, with the time in seconds since the epoch. `kind` is state, step_started, step_done,
    step_failed, progress, safe_stop, note, fault, confirm_needed, confirmed, decided, paused, going_on or run_ended."""

    kind: str
    step: str | None
    data: Mapping[str, object]
    at: float = field(default_factory=time.time)


Observer = Callable[[Event], None]


class StepContext:
    """What a step is given: earlier results, its deadline, its end, and ways to report.

    `results` maps the earlier steps' names to what they returned. `deadline` is in seconds of the cell's clock.
    `token` ends this attempt: with the run, or by itself when the attempt is cut short. `check` lets held work
    see what is asked of the run, where nobody else looks for it.
    """

    def __init__(
        self, step: Step, attempt: int, deadline: float, results: Mapping[str, object], clock: RunClock,
        notify: Observer, control: RunControl | None = None, check: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        self.step = step
        self.attempt = attempt
        self.deadline = deadline
        self.results = results
        self._clock = clock
        self._notify = notify
        self._control = control or RunControl()
        self._check = check
        self.token = CancelToken(self._control.token)

    def made(self, kind: type[Made]) -> Made:
        """The newest result of the earlier steps that is of this type; LookupError when none of them made one."""
        for result in reversed(list(self.results.values())):
            if isinstance(result, kind):
                return result
        raise LookupError(f"{self.step.name} needs a {kind.__name__}, which none of {', '.join(self.results)} made")

    def remaining(self) -> float:
        """Seconds of the cell's clock until the deadline, at least 0."""
        return max(0.0, self.deadline - self._clock.now())

    def check(self) -> None:
        """Raise `Cancelled` if the step is to end now. For loops that wait for no device."""
        self.token.check()

    def safe_point(self) -> None:
        """A moment at which nothing moves and the laser is off: a paused run is held here. Raises like `check`."""

        def say(held: bool) -> None:
            kind = "paused" if held else "going_on"
            self._notify(Event(kind, self.step.name, {"text": "held before its next motion" if held else "goes on"}))

        self._control.safe_point(self.token, say, self._check)

    @property
    def held_s(self) -> float:
        """For how long, wall seconds, the run was held so far: what was seen before a hold may have changed in it."""
        return self._control.held_s

    def progress(self, fraction: float, text: str = "") -> None:
        """Tell the observer how far the step is, 0 to 1; not written to the journal. Raises like `check`."""
        self.check()
        self._notify(Event("progress", self.step.name, {"fraction": fraction, "text": text}))

    def ask(self, what: str) -> None:
        """Wait, however long, for a person's word about `what`. Nothing may move meanwhile. Raises like `check`."""
        about = {"reason": what, "code": self.step.name, "number": self._control.ask(what)}
        self._notify(Event("confirm_needed", self.step.name, about))
        try:
            while (by := self._control.answer()) is None:
                self.token.event.wait(0.02)
                self.check()
                self._check()
        finally:
            self._control.asked_no_more()
        self._notify(Event("confirmed", self.step.name, {"by": by, "reason": what}))
        self.safe_point()

    def note(self, **data: object) -> None:
        """Write something worth keeping to the journal and tell the observer."""
        self._notify(Event("note", self.step.name, data))

    def fault(self, code: str, reason: str) -> None:
        """Note a fault that the step goes on after; it is in the run's faults."""
        self._notify(Event("fault", self.step.name, {"attempt": self.attempt, "code": code, "reason": reason}))


@dataclass(frozen=True)
class StepRecord:
    """How one step went; `state` is open, done or failed. `duration_s` sums all attempts in seconds of the cell's
    clock, `wall_s` in seconds on the wall."""

    name: str
    state: str = "open"
    duration_s: float = 0.0
    retries: int = 0
    wall_s: float = 0.0


@dataclass(frozen=True)
class FaultRecord:
    """A fault or a failed attempt on the way, and what was done about it. `at` is in seconds since the epoch; `code` is
    short and stable; `remedy` is tried again, recovered, confirmed by a person, noted, or ended the run."""

    at: float
    step: str
    attempt: int
    code: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class RunResult:
    """How a run ended. `signal` is the number of the signal that ended it; `error` the exception behind the end.
    `faults` are all that was met on the way, in their order, also those that the run went on after."""

    outcome: Outcome
    reason: str
    code: str
    steps: tuple[StepRecord, ...]
    results: Mapping[str, object]
    error: BaseException | None = None
    signal: int | None = None
    faults: tuple[FaultRecord, ...] = ()


StepCall = Callable[[StepContext], object]
"""A step's work: takes its context and returns what it made."""
