"""Promises of `drivers.arm.dashboard`."""

import time

import pytest

from drivers.arm.dashboard import Dashboard
from drivers.errors import DeadlineError, NotConnectedError


def test_the_dashboard_answers_line_by_line_over_one_connection(dashboard):
    unasked = {"stop": "you said stop\nnobody asked for this"}
    board, asked = dashboard(lambda question: unasked.get(question, f"you said {question}"))
    assert (board.ask("robotmode"), board.ask("stop")) == ("you said robotmode", "you said stop")
    time.sleep(0.1)
    assert board.ask("robotmode") == "you said robotmode"
    assert asked == ["robotmode", "stop", "robotmode"]
    board.close()


def test_a_server_that_was_started_again_is_connected_anew_and_nothing_is_sent_twice(dashboard):
    board, asked = dashboard(lambda question: f"you said {question}")
    assert board.ask("quit") == "you said quit"
    time.sleep(0.05)
    assert board.ask("stop") == "you said stop"
    assert asked == ["quit", "stop"]
    board.close()


def test_a_silent_dashboard_is_a_deadline_and_a_missing_one_is_not_connected(dashboard):
    board, _ = dashboard(lambda question: None, timeout=0.05)
    with pytest.raises(DeadlineError, match=r"did not answer 'stop' within 0\.05 s"):
        board.ask("stop")
    with pytest.raises(NotConnectedError, match=r"127\.255\.0\.9:29999 is not reachable"):
        Dashboard("arm", "127.255.0.9").ask("stop")
