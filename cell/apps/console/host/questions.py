"""What a person has to decide: a step was refused, or a fault waits for somebody's word."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from cell.apps.console.view.run_view import RunView
from cell.run.runs import Run
from drivers.errors import ConfigError, Measured, RefusedError
from statemachine.runner import Again, Script
from statemachine.step import Failure

LOOK_S = 0.05
CONFIRM, AGAIN, ABORT = "confirm", "again", "abort"


class Questions:
    """The question of the run that goes on, if it has one; `script` is what a job is begun with, so that it asks."""

    def __init__(self) -> None:
        self._run: Run[object] | None = None
        self._lock = threading.Lock()
        self._numbers = 0
        self._refusal: dict[str, Any] | None = None
        self._answer: tuple[str, str | None, str] | None = None
        self._answered = threading.Event()

    def script(self, steps: tuple[str, ...], seen: Callable[[], bool] = lambda: True) -> Script:
        """Asks about each refusal of a run of these steps, and waits; `hold` tells it the run once it is there.

        Nobody is asked, and the refusal ends the run, when it is not `seen` by anybody then.
        """
        self._run = None
        return Script(on_refusal=lambda name, failure: self._ask(name, failure, steps) if seen() else None)

    def hold(self, run: Run[object]) -> None:
        """This is the run that asks."""
        self._run = run

    def present(self, view: RunView | None) -> dict[str, object] | None:
        """The question as the page shows it, or None."""
        if (refusal := self._refusal) is not None:
            return refusal
        if view is None or view.asked is None:
            return None
        run = view.run
        choices: list[dict[str, object]] = [{"choice": CONFIRM}, {"choice": ABORT}]
        return {"kind": "confirm", **view.asked, "numbers": [], "picture": _picture(run), "choices": choices}

    def decide(self, run: Run[object], number: int, choice: str, step: str | None, by: str, reason: str) -> str:
        """A person's answer; `ConfigError` when it fits no question, or names nobody and no reason."""
        by, reason = " ".join(by.split()), " ".join(reason.split())
        if not by or not reason:
            raise ConfigError("a decision needs the name of who decides, and the reason; both are recorded")
        said = f"{by}: {reason}"
        with self._lock:
            refusal = self._refusal
            if refusal is None:
                return self._confirm(run, number, choice, said)
            if number != refusal["number"]:
                raise ConfigError(f"question {number} is not asked any more; it is now question {refusal['number']}")
            steps = next(row["steps"] for row in refusal["choices"] if row["choice"] == AGAIN)
            if choice not in (AGAIN, ABORT) or (choice == AGAIN and step not in steps):
                raise ConfigError(f"{choice} {step or ''} is no choice here: again from {', '.join(steps)}, or abort")
            self._answer = choice, step, said
            self._answered.set()
        return f"again from {step}" if choice == AGAIN else "the run ends"

    def _confirm(self, run: Run[object], number: int, choice: str, said: str) -> str:
        if choice == ABORT:
            run.abort(said)
            return "the run ends"
        if choice != CONFIRM:
            raise ConfigError(f"{choice!r} is no choice here: confirm, or abort")
        if not run.confirm(said, number):
            raise ConfigError(f"question {number} is not asked any more; nothing was confirmed")
        return f"question {number} is confirmed"

    def _given(self) -> tuple[str, str | None, str]:
        with self._lock:
            return self._answer or (ABORT, None, "no answer was given")

    def _ask(self, name: str, failure: Failure, steps: tuple[str, ...]) -> Again | None:
        """Called by the run, with the cell at rest."""
        with self._lock:
            self._numbers += 1
            self._answer = None
            self._answered.clear()
            allowed = list(steps[: steps.index(name) + 1])
            self._refusal = {
                "number": self._numbers, "kind": "refusal", "step": name, "code": failure.code,
                "reason": failure.reason, "numbers": _numbers(failure.error), "picture": _picture(self._run),
                "choices": [{"choice": AGAIN, "steps": allowed}, {"choice": ABORT}],
            }  # fmt: skip
        try:
            while not self._answered.wait(LOOK_S):
                run = self._run
                if run is not None and run.control.token.reason is not None:
                    return None
            choice, step, said = self._given()
        finally:
            with self._lock:
                self._refusal = None
        if choice == AGAIN and step is not None:
            return Again(step, said)
        raise RefusedError(f"{failure.reason}; {said}, and let the run end").showing(*_measured(failure.error))


def _measured(error: BaseException | None) -> tuple[Measured, ...]:
    return error.numbers if isinstance(error, RefusedError) else ()


def _numbers(error: BaseException | None) -> list[dict[str, object]]:
    rows = [number.as_dict() for number in _measured(error)]
    return [{"name": row["name"], "value": row["value"], "limit": row["limit"], "unit": row["unit"], "ok": row["kept"]}
            for row in rows]  # fmt: skip


def _picture(run: Run[object] | None) -> str | None:
    """Where the page finds what was looked at last."""
    if run is None or run.folder is None or run.frames is None or not run.frames.recent:
        return None
    return f"/api/runs/{run.folder.name}/pictures/{run.frames.recent[-1]}"
