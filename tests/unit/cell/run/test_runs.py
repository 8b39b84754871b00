"""Promises of `cell.run.runs`."""

import os
import signal
import time

import pytest

from cell.run.runs import Run
from statemachine.watch import SignalInterrupt
from tests.support import until


def ask_to_end() -> None:
    """A SIGTERM as soon as somebody waits for it."""
    assert until(lambda: signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL, 5.0)
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize("late", [0.0, 0.2])
def test_a_signal_at_the_very_end_of_a_job_leaves_its_result_and_is_kept(late: float):
    def work(run: Run[int]) -> int:
        run.control.over = True
        ask_to_end()
        time.sleep(late)  # within the waiting's last look, or after it
        return 7

    run = Run("job", work)
    assert (run.result(5.0), run.control.signal) == (7, signal.SIGTERM)


@pytest.mark.parametrize("late", [0.0, 0.2])
def test_a_signal_as_other_work_ends_ends_the_program_too(late: float):
    def work(run: Run[int]) -> int:
        ask_to_end()
        time.sleep(late)
        return 7

    with pytest.raises(SignalInterrupt, match="asked to end"):
        Run("jog", work).result(5.0)
