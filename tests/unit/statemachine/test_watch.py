"""Promises of `statemachine.watch`."""

import os
import signal
import threading
import time

import pytest

from statemachine.watch import EndSignals, SignalInterrupt, SignalWatch


def test_nested_contexts_leave_the_programs_own_handlers_as_they_were():
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)]
    outer, inner = EndSignals(), EndSignals()
    with outer:
        pass
    inner.__enter__()
    assert signal.getsignal(signal.SIGTERM) == inner._raise
    with pytest.raises(SignalInterrupt, match="asked to end"):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)  # what is cleaned up after the first is not cut short by a second
    inner.__exit__(None, None, None)
    assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)] == before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_each_signal_to_end_is_raised_outside_of_a_run(number: int):
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)
    try:
        with EndSignals(keyboard=True):
            assert signal.getsignal(number) is not usual
            with pytest.raises(SignalInterrupt) as caught:
                signal.raise_signal(number)
            assert caught.value.number == number
    finally:
        signal.signal(number, before)


def test_outside_the_main_thread_signals_are_left_alone():
    def work():
        with SignalWatch() as watch:
            seen.append(watch.reason)

    seen = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join(5)
    assert seen == [None]
