"""Lets a run's script work between two steps, watched as the steps are."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from statemachine.cancel import CancelToken
from statemachine.policy import Failure, Outcome
from statemachine.script import Again, Script
from statemachine.watchman import Watchman


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
