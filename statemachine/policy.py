"""Deadlines, retries and recovery choices of the steps, as data.

Exceptions are named by their class names, so that a policy can be written without importing what raises them.
A failure is looked at in this order: an end that was asked for; a retry; a recovery; the end of the run.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum


class Outcome(Enum):
    """How a run ended: done where nothing is placed."""

    PLACED = "placed"
    DONE = "done"
    REFUSED = "refused"
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

    def with_step(self, step: Step) -> Policy:
        """A copy in which the policy of `step.name` is `step`."""
        return replace(self, steps=tuple(step if old.name == step.name else old for old in self.steps))
