"""Nothing begins after a stop: whoever was working is barred for ever, new work is not."""

import threading
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from cell.devices.gate.gate import Gate
from cell.devices.gate.interlocks import DeviceCommand, Interlocks, Rule, Situation
from drivers.errors import Aborted, InterlockError
from statemachine.control import CancelToken

MOVE = DeviceCommand("rail", "move_to", {"position": 0.0})


def open_gate() -> Gate:
    """A gate without devices and rules."""
    nothing = Situation(None, None, None, None, {}, lambda joints, command: (), lambda joints: None, {}, "")
    return Gate(Interlocks(nothing, ()))


def test_work_that_entered_before_a_stop_begins_nothing_after_it():
    gate, begun = open_gate(), []
    gate.enter(CancelToken())
    assert gate.begin(MOVE, lambda: 7, lambda: None) == 7
    gate.shut()
    with pytest.raises(Aborted):
        gate.begin(MOVE, lambda: begun.append("motion"), lambda: None)
    assert begun == []


def test_who_listens_hears_what_passed_and_what_was_refused_with_why():
    gate, heard = open_gate(), []
    gate.listener = SimpleNamespace(command=lambda command, refused: heard.append((command, refused)))
    gate.enter(CancelToken())
    gate.require(MOVE)
    gate.shut()
    with pytest.raises(Aborted) as barred:
        gate.require(MOVE)
    assert heard == [(MOVE, None), (MOVE, str(barred.value))]


@pytest.mark.parametrize("stopped", [True, False], ids=["stopped", "its run cancelled"])
def test_a_stop_or_the_end_of_its_run_that_comes_while_something_begins_undoes_it(stopped: bool):
    gate, undone, token = open_gate(), [], CancelToken()
    gate.enter(token)
    with pytest.raises(Aborted):
        gate.begin(MOVE, gate.shut if stopped else lambda: token.cancel("enough"), lambda: undone.append("stopped"))
    assert undone == ["stopped"]


def test_new_work_may_enter_and_an_abandoned_thread_stays_barred():
    gate = open_gate()
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


def test_a_thread_that_never_entered_is_barred_by_a_stop_until_a_person_clears_it_not_by_anothers_run():
    gate, said = open_gate(), []

    def script() -> None:
        try:
            gate.require(MOVE)
            said.append("passed")
        except InterlockError as error:
            said.append(str(error))

    def in_a_thread(work: Callable[[], object]) -> None:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join(5)

    in_a_thread(script)
    gate.shut()
    in_a_thread(script)
    in_a_thread(lambda: gate.enter(CancelToken()))
    in_a_thread(script)
    gate.clear()
    in_a_thread(script)
    assert [text if text == "passed" else "after_a_stop" in text for text in said] == [
        "passed", True, True, "passed",
    ]  # fmt: skip


def test_a_stop_that_comes_after_those_that_are_cleared_still_bars():
    """A run clears the stop at its own end; one that a person asks for at that moment is not cleared with it."""
    gate = open_gate()
    gate.shut()
    stops = gate.stops
    gate.shut()
    gate.clear(stops)
    assert not gate.is_open
    with pytest.raises(InterlockError, match="after_a_stop"):
        gate.require(MOVE)
    gate.clear(stops + 1)
    gate.require(MOVE)
    gate.clear(stops)  # what was cleared once stays so
    gate.require(MOVE)


def test_work_whose_run_is_to_end_begins_nothing_even_before_anything_was_stopped():
    gate, begun = open_gate(), []
    run = CancelToken()
    step = CancelToken(run)
    gate.enter(step)
    gate.require()
    run.cancel("enough")
    with pytest.raises(Aborted, match="enough"):
        gate.begin(MOVE, lambda: begun.append("motion"), lambda: None)
    assert begun == []


def test_a_script_works_with_its_runs_token_in_any_thread_and_leaves_no_trace():
    gate, ended, run = open_gate(), CancelToken(), CancelToken()
    gate.enter(ended)
    ended.cancel("the step has ended")
    gate.shut()
    with gate.entered(run):
        gate.require(MOVE)
        run.cancel("enough")
        with pytest.raises(Aborted, match="enough"):
            gate.require(MOVE)
    with pytest.raises(Aborted, match="the step has ended"):
        gate.require(MOVE)


def test_a_stop_that_comes_while_the_rules_wait_lets_nothing_begin():
    gate, begun, undone = open_gate(), [], []
    token = CancelToken()
    rule = Rule("slow", ("rail.move_to",), "", lambda now, command: token.cancel("enough") and None)
    slow = Gate(Interlocks(gate.interlocks.situation, (rule,)))
    slow.enter(token)
    with pytest.raises(Aborted, match="enough"):
        slow.begin(MOVE, lambda: begun.append("motion"), lambda: undone.append("stopped"))
    assert (begun, undone) == ([], [])
