"""Promises of `statemachine.control`."""

import signal
import threading
import time

import pytest

from statemachine.control import Cancelled, CancelToken, RunControl


def test_who_asks_for_the_end_just_as_the_run_has_it_is_late():
    """The run comes to its end while it is being asked to: between the two nothing is lost."""

    class EndsMeanwhile(CancelToken):
        def cancel(self, reason):
            control.over = True
            assert super().cancel("the run has ended")
            return super().cancel(reason)

    control = RunControl()
    control.token = EndsMeanwhile()
    control.abort("Cell.stop()")
    assert control.late


def test_the_signal_that_ended_a_run_is_told_whoever_asks_afterwards():
    control = RunControl()
    control.abort("terminated", signal.SIGTERM)
    control.abort("interrupted from the keyboard", signal.SIGINT)
    assert control.signal == signal.SIGTERM
    control = RunControl()
    control.abort("Cell.stop()")
    control.abort("interrupted from the keyboard", signal.SIGINT)
    assert control.signal is None


def test_held_work_ends_with_its_own_token_though_the_run_stays_paused():
    """Its deadline, or another fault, ends it where it is held."""
    control, token = RunControl(), CancelToken()
    control.pause()
    threading.Timer(0.05, lambda: token.cancel("overrun")).start()
    threading.Timer(2.0, control.go_on).start()
    begun = time.monotonic()
    with pytest.raises(Cancelled, match="overrun"):
        control.safe_point(token, lambda held: None)
    assert time.monotonic() - begun < 1.0
    assert 0.0 < control.held_s < 1.0


def test_a_reason_with_bytes_that_are_no_text_ends_the_run_all_the_same():
    token = CancelToken()
    assert token.cancel("J\udcf6rg says stop")
    assert token.reason == "J\\udcf6rg says stop"


def test_what_begins_after_its_run_was_ended_is_ended_as_it_begins():
    run, told = CancelToken(), []
    run.cancel("enough")
    late = CancelToken(run)
    late.on_cancel(told.append)
    assert (late.reason, told, late.event.is_set()) == ("enough", ["enough"], True)
    assert not late.cancel("later")
    assert late.reason == "enough"


def test_a_word_that_was_given_before_it_was_asked_for_does_not_count():
    control = RunControl()
    assert not control.confirm("too early")
    control.ask("protective stop")
    assert control.answer() is None and control.confirm("Ann")
    assert control.answer() == "Ann"


def test_a_word_about_an_earlier_fault_does_not_count_for_the_next():
    control = RunControl()
    first = control.ask("protective stop in the sweep")
    assert control.question == (first, "protective stop in the sweep")
    assert control.confirm("Ann", first)
    control.asked_no_more()
    assert control.question is None
    second = control.ask("protective stop while placing")
    assert not control.confirm("a listener that is late", first) and control.answer() is None
    assert control.confirm("Ann", second)
