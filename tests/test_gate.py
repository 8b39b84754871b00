"""Nothing begins after a stop: whoever was working is barred for ever, new work is not."""

from __future__ import annotations

import threading

import pytest

from cell.devices.gate import Gate
from drivers.errors import Aborted
from statemachine.cancel import CancelToken


def test_work_that_entered_before_a_stop_begins_nothing_after_it() -> None:
    gate, begun = Gate(), []
    gate.enter(CancelToken())
    assert gate.begin(lambda: 7, lambda: None) == 7
    gate.shut()
    with pytest.raises(Aborted):
        gate.begin(lambda: begun.append("motion"), lambda: None)
    assert begun == []


def test_a_stop_that_comes_while_something_begins_undoes_it() -> None:
    gate, undone = Gate(), []
    gate.enter(CancelToken())
    with pytest.raises(Aborted):
        gate.begin(gate.shut, lambda: undone.append("stopped"))
    assert undone == ["stopped"]


def test_new_work_may_enter_and_an_abandoned_thread_stays_barred() -> None:
    gate = Gate()
    entered, go_on, outcome = threading.Event(), threading.Event(), []

    def abandoned() -> None:
        gate.enter(CancelToken())
        entered.set()
        go_on.wait(5)
        try:
            gate.require()
            outcome.append("went on")
        except Aborted:
            outcome.append("barred")

    thread = threading.Thread(target=abandoned)
    thread.start()
    entered.wait(5)
    gate.shut()
    gate.enter(CancelToken())
    gate.require()
    go_on.set()
    thread.join(5)
    assert outcome == ["barred"]


def test_a_thread_that_never_entered_is_not_barred() -> None:
    gate = Gate()
    gate.shut()
    gate.require()


def test_work_whose_run_is_to_end_begins_nothing_even_before_anything_was_stopped() -> None:
    gate, begun = Gate(), []
    run = CancelToken()
    step = CancelToken(run)
    gate.enter(step)
    gate.require()
    run.cancel("enough")
    with pytest.raises(Aborted, match="enough"):
        gate.begin(lambda: begun.append("motion"), lambda: None)
    assert begun == []


def test_a_run_that_is_cancelled_while_something_begins_has_it_undone() -> None:
    gate, undone = Gate(), []
    token = CancelToken()
    gate.enter(token)
    with pytest.raises(Aborted):
        gate.begin(lambda: token.cancel("enough"), lambda: undone.append("stopped"))
    assert undone == ["stopped"]
