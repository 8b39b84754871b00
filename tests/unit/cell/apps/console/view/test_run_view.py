"""A run as the page shows it."""

import threading
from typing import Any

import pytest

from cell.apps.console.host.controller import Questions
from cell.apps.console.view.run_view import RunView
from cell.run.runs import Run
from statemachine.step import Event

STEPS = ("board_photo", "laser_sweep", "reconstruct")


def test_a_run_is_followed_by_its_own_events():
    seen, begun, end = threading.Event(), threading.Event(), threading.Event()

    def work(run: Run[Any]) -> None:
        seen.wait(10)
        run.notify(Event("progress", "calibrate", {"fraction": 1.0, "text": "stored"}))
        run.notify(Event("step_started", "board_photo", {"attempt": 1}))
        run.notify(Event("progress", "board_photo", {"fraction": 0.5, "text": "to the board"}))
        fault = {"attempt": 1, "code": "arm.link_lost", "reason": "cut", "remedy": "recovered"}
        run.notify(Event("fault", "board_photo", fault))
        question = {"reason": "look", "code": "arm.protective_stop", "number": 1}
        run.notify(Event("confirm_needed", "board_photo", question))
        begun.set()
        end.wait(10)
        run.notify(Event("run_ended", None, {"outcome": "placed", "reason": "all steps done"}))

    run: Run[Any] = Run("job", work)
    view = RunView(run, STEPS, "pot", {"board_photo": 10.0, "laser_sweep": 5.0, "reconstruct": 1.0})
    seen.set()
    assert begun.wait(5)
    view.news()
    told = view.as_dict()
    # A first calibration stands before the steps, and has ended with the first of them.
    assert told["steps"][0]["name"] == "calibrate"
    assert (told["state"], told["step"], told["fraction"]) == ("asking", "board_photo", 0.5)
    assert told["left_s"] == pytest.approx(16.0, abs=1.0)
    assert [step["state"] for step in told["steps"]] == ["done", "active", "open", "open"]
    assert view.faults[0]["device"] == "arm"
    question = Questions().present(view)
    assert [choice["choice"] for choice in question["choices"]] == ["confirm", "abort"]
    end.set()
    run.ended(5)
    view.news()
    assert view.over
    assert view.ended is not None and view.ended["outcome"] == "placed"
