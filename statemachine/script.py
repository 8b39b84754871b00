"""What a script may do between the steps of a run: look at a result, and decide on a refusal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from statemachine.cancel import CancelToken
from statemachine.policy import Failure, Outcome
from statemachine.watchman import Watchman


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
    asking. Both run with the cell at rest, for as long as they like.
    """

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
        if (look := self._script.after.get(name)) is None:
            return None
        return self._do(name, lambda: look(result))[0]

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
