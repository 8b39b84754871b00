"""A refused step is asked about, with its numbers and what may be decided."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from cell.apps.console.host.questions import Questions
from cell.run.runs import Run
from drivers.errors import ConfigError, Measured, RefusedError
from statemachine.runner import Again
from statemachine.step import Failure, Outcome
from tests.support import until

STEPS = ("board_photo", "laser_sweep", "reconstruct")


def asked(questions: Questions, run: Run[Any]) -> tuple[list[object], threading.Thread]:
    """A run of these steps that is refused at its sweep, in a thread of its own."""
    made: list[object] = []
    number = Measured("stripe, rows seen", 12, "rows", least=200)
    failure = Failure(Outcome.REFUSED, "too little stripe", "RefusedError", error=RefusedError("x", number))
    decide = questions.script(STEPS).on_refusal
    assert decide is not None
    questions.hold(run)

    def ask() -> None:
        try:
            made.append(decide("laser_sweep", failure))
        except RefusedError as error:
            made.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    assert until(lambda: questions.present(None) is not None)
    return made, thread


def test_a_refusal_is_shown_with_its_numbers_and_the_choices_that_the_policy_allows() -> None:
    questions, end = Questions(), threading.Event()
    run: Run[Any] = Run("job", lambda run: end.wait(10))
    made, thread = asked(questions, run)
    shown = questions.present(None)
    assert shown is not None
    assert shown["numbers"] == [{"name": "stripe, rows seen", "value": 12, "limit": 200, "unit": "rows", "ok": False}]
    again, abort = shown["choices"]
    assert again == {"choice": "again", "steps": ["board_photo", "laser_sweep"]}
    assert abort == {"choice": "abort"}
    number = shown["number"]
    for wrong in (
        (number + 1, "again", "laser_sweep", "Ann", "dust"),
        (number, "again", "reconstruct", "Ann", "dust"),
        (number, "confirm", None, "Ann", "dust"),
        (number, "again", "laser_sweep", " ", "dust"),
        (number, "again", "laser_sweep", "Ann", " \n"),
    ):
        with pytest.raises(ConfigError):
            questions.decide(run, *wrong)
    questions.decide(run, number, "again", "board_photo", "Ann", "wiped the lens")
    thread.join(5)
    assert made == [Again("board_photo", "Ann: wiped the lens")]
    assert questions.present(None) is None

    made, thread = asked(questions, run)
    later = questions.present(None)
    assert later is not None
    questions.decide(run, later["number"], "abort", None, "Bob", "the part is scrap")
    thread.join(5)
    assert isinstance(made[0], RefusedError)
    assert "Bob: the part is scrap" in str(made[0])
    end.set()


def test_a_run_that_is_ended_asks_no_more() -> None:
    questions, end = Questions(), threading.Event()
    run: Run[Any] = Run("job", lambda run: end.wait(10))
    made, thread = asked(questions, run)
    run.abort("stopped")
    thread.join(5)
    assert made == [None]
    end.set()


def test_nobody_is_asked_where_nobody_looks() -> None:
    decide = Questions().script(STEPS, seen=lambda: False).on_refusal
    assert decide is not None
    assert decide("board_photo", Failure(Outcome.REFUSED, "no board")) is None
