"""What one step of a job is: how it is watched, what it needs of earlier steps, what it makes, and what it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cell.procedures.steps.workplace import Workplace
from statemachine.policy import Step
from statemachine.runner import StepContext


@dataclass(frozen=True)
class JobStep:
    """`work(workplace, context)` returns a `makes`; it takes what it `needs`, by type, with `context.made(type)`."""

    policy: Step
    work: Callable[[Workplace, StepContext], object]
    makes: type
    needs: tuple[type, ...] = ()

    @property
    def name(self) -> str:
        """The step's name, in reports and on the command line."""
        return self.policy.name
