"""What ends a step that goes on: its deadline, a person, a signal, the cell's health; and the safe stop after it."""

import os
import signal
import sqlite3
import time
from contextlib import contextmanager
from threading import Event

import pytest

from drivers.clock import Clock
from statemachine.journal import FILE_NAME, request
from statemachine.runner import StepContext
from statemachine.step import Outcome
from tests.support.runner_bench import POLICY, Bench, failing


def test_a_step_that_overruns_is_stopped_and_named(tmp_path):
    bench = Bench(tmp_path, laser_sweep=lambda context: bench.stopped.wait(5)).policy("laser_sweep", 0.05)
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert "laser_sweep did not end within its deadline" in result.reason
    assert result.code == "step.deadline"


def test_a_step_that_only_reports_progress_learns_that_it_is_to_end(tmp_path):
    def work(context):
        while True:
            context.progress(0.5, "going through what has piled up")

    result = Bench(tmp_path, laser_sweep=work).policy("laser_sweep", 0.05).run()
    assert result.outcome is Outcome.FAULTED
    assert "still busy" not in result.reason


def test_a_step_that_does_not_end_even_after_the_stop_is_left_behind_and_not_repeated(tmp_path):
    release = Event()
    bench = Bench(tmp_path, laser_sweep=lambda context: release.wait(20))
    result = bench.policy("laser_sweep", 0.05, 3, ("StepOverrun",)).times(grace_s=0.1).run()
    release.set()
    assert result.outcome is Outcome.FAULTED
    assert "still busy 0.1 s after the stop" in result.reason
    assert bench.log.count("laser_sweep") == 1


def test_a_computing_step_has_its_deadline_on_the_wall(tmp_path):
    left = {}
    bench = Bench(
        tmp_path, clock=Clock(rate=10),
        laser_sweep=lambda context: left.update(moving=context.remaining()),
        reconstruct=lambda context: left.update(computing=context.remaining()),
    )  # fmt: skip
    bench.policy("laser_sweep", 60.0).policy("reconstruct", 60.0, on_wall=True).run()
    assert (left["moving"], left["computing"]) == (pytest.approx(60, abs=10), pytest.approx(600, abs=10))


def test_past_its_deadline_a_step_has_no_time_left():
    context = StepContext(POLICY.of("place"), 1, 0.0, {}, Clock(), lambda event: None)
    assert context.remaining() == 0.0


# --- who asks for the end ---


def test_who_asks_as_the_run_comes_to_its_end_is_heard(tmp_path):
    bench = Bench(tmp_path)
    bench.on_stop = lambda: [request(tmp_path, kind, "cell abort") for kind in ("end-batch", "abort")]
    assert bench.run().outcome is Outcome.PLACED
    assert bench.control.end_batch and bench.control.late


def test_an_abort_while_a_step_computes_ends_the_run_and_no_step_follows(tmp_path):
    def work(context):
        bench.control.abort("Cell.stop() was called")
        return "a result that comes too late"

    bench = Bench(tmp_path, reconstruct=work)
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.ABORTED, "Cell.stop() was called")
    assert "invert_pose" not in bench.log


@contextmanager
def outlived(number):
    """A signal that the runner does not take fails the test in here, and does not end pytest."""
    before = signal.signal(number, lambda number, frame: None)
    try:
        yield
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize(
    ("ask", "reason", "number"),
    [
        (lambda bench: bench.control.abort("seen enough"), "seen enough", None),
        (lambda bench: request(bench.folder, "abort", "cell abort"), "cell abort", None),
        (lambda bench: os.kill(os.getpid(), signal.SIGTERM), "asked to end (SIGTERM)", signal.SIGTERM),
        (lambda bench: os.kill(os.getpid(), signal.SIGHUP), "asked to end (SIGHUP)", signal.SIGHUP),
    ],
    ids=["another thread", "another process", "SIGTERM", "SIGHUP"],
)
def test_whoever_asks_for_the_end_stops_the_moving_step(tmp_path, ask, reason, number):
    def work(context):
        ask(bench)
        assert bench.stopped.wait(5), "the cell is stopped while the step still runs"
        raise OSError("the motion was stopped")

    bench = Bench(tmp_path, laser_sweep=work)
    with outlived(signal.SIGTERM), outlived(signal.SIGHUP):
        result = bench.run()
    assert (result.outcome, result.reason, result.signal) == (Outcome.ABORTED, reason, number)
    assert "reconstruct" not in bench.log


def test_ctrl_c_aborts_and_a_second_one_does_not_cut_the_safe_stop_short(tmp_path):
    def interrupt(times=1):
        for _ in range(times):
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    bench = Bench(tmp_path, laser_sweep=lambda context: (interrupt(), bench.stopped.wait(5)))
    bench.on_stop = lambda: interrupt(3)
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.ABORTED, "interrupted from the keyboard")
    assert result.signal == signal.SIGINT
    assert signal.getsignal(signal.SIGINT) is before


# --- the cell's health ---


def ailing(bench):
    """Health of a cell that ails while it sweeps."""

    def health():
        if bench.log[-1:] == ["laser_sweep"]:
            raise ValueError("the vehicle reports a fault")

    return health


def test_ill_health_ends_the_step_whatever_it_does(tmp_path):
    bench = Bench(tmp_path, laser_sweep=lambda context: bench.stopped.wait(5))
    bench.runner.health = ailing(bench)
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "the vehicle reports a fault")
    assert [record.name for record in result.steps if record.state == "failed"] == ["laser_sweep"]


def test_what_ails_the_cell_is_written_down_once_it_stands(tmp_path):
    """A disk that stalls must not keep the arm moving."""

    def event(kind, *rest):
        if kind == "traceback":
            bench.log.append("written")
        write(kind, *rest)

    bench = Bench(tmp_path, laser_sweep=lambda context: bench.stopped.wait(5))
    write, bench.runner.journal.event = bench.runner.journal.event, event
    bench.runner.health = ailing(bench)
    assert bench.run().reason == "the vehicle reports a fault"
    assert bench.log[3:5] == ["stop: the vehicle reports a fault", "written"]


def test_an_ailing_cell_is_found_before_an_attempt_begins(tmp_path):
    bench = Bench(tmp_path, health=lambda: failing(ValueError("the emergency stop is pressed"))(None))
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "the emergency stop is pressed")
    assert "drive_to_target" not in bench.log


def test_a_failure_that_cannot_be_classified_is_a_fault(tmp_path):
    bench = Bench(tmp_path, board_photo=failing(ValueError("no board")))
    bench.runner.classify = lambda error: {}["no such kind"]
    result = bench.run()
    assert (result.outcome, result.code) == (Outcome.FAULTED, "run.internal")
    assert "no board" in result.reason and "no such kind" in result.reason


# --- the safe stop ---


def test_a_safe_stop_that_fails_makes_the_run_faulted(tmp_path):
    result = Bench(tmp_path, "end of the run").run()
    assert result.outcome is Outcome.FAULTED
    assert "vehicle stopped and braked: not confirmed" in result.reason


def test_a_safe_stop_that_ends_too_late_makes_the_run_faulted(tmp_path):
    bench = Bench(tmp_path).times(stop_deadline_s=0.2)
    bench.on_stop = lambda: bench.runner.clock.sleep(0.6)
    result = bench.runner.run()
    assert result.outcome is Outcome.FAULTED
    assert "did not end within 0.2 s" in result.reason


def test_a_safe_stop_that_takes_its_time_is_waited_for(tmp_path):
    bench = Bench(tmp_path)
    bench.on_stop = lambda: time.sleep(0.4)
    assert bench.run().outcome is Outcome.PLACED


class StallingDisk:
    """Another connection that holds the journal's file: whoever writes waits until it lets go."""

    def __init__(self, folder):
        self._base = sqlite3.connect(folder / FILE_NAME, isolation_level=None, check_same_thread=False)

    def stall_until_stopped(self, bench):
        """Stall now; the first stop ends it and gives how long it came after the stall's beginning in `waited`."""

        def on_stop():
            bench.waited.append(time.monotonic() - since)
            if self._base.in_transaction:
                self._base.execute("ROLLBACK")

        bench.waited, bench.on_stop = [], on_stop
        self._base.execute("BEGIN IMMEDIATE")
        since = time.monotonic()


@pytest.mark.parametrize("error", [OSError("the arm is gone"), ConnectionError("the link is lost")])
def test_a_disk_that_stalls_does_not_hold_up_the_stop_after_a_failed_step(tmp_path, error):
    def work(context):
        if context.attempt == 1:
            disk.stall_until_stopped(bench)
            raise error

    bench = Bench(tmp_path, laser_sweep=work).policy("laser_sweep", 10.0, 1).recovers()
    disk = StallingDisk(tmp_path)
    bench.run()
    assert bench.waited[0] < 0.5
    assert next(row.state for row in bench.record.steps if row.name == "laser_sweep") == "failed"


def test_a_step_that_waits_for_the_disk_is_watched_all_the_same(tmp_path):
    def work(context):
        disk.stall_until_stopped(bench)
        context.note(lost_frames=2)
        context.token.event.wait(5)

    bench = Bench(tmp_path, laser_sweep=work).policy("laser_sweep", 0.3)
    disk = StallingDisk(tmp_path)
    assert bench.run().code == "step.deadline"
    assert bench.waited[0] < 1.0


def test_who_asks_from_another_process_is_heard_while_the_disk_stalls(tmp_path):
    def work(context):
        request(tmp_path, "abort", "cell abort")
        disk.stall_until_stopped(bench)
        context.note(lost_frames=2)

    bench = Bench(tmp_path, laser_sweep=work)
    disk = StallingDisk(tmp_path)
    assert bench.run().reason == "cell abort"
    assert bench.waited[0] < 1.0
