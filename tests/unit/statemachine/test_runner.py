"""The runner: every run ends safe, with the outcome that its steps deserve, and everything is in the journal."""

from __future__ import annotations

import os
import signal
import sqlite3
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import pytest

from drivers.clock import Clock
from statemachine.control import RunControl
from statemachine.journal import FILE_NAME, Journal, read, request
from statemachine.runner import Again, Runner, Script, StepContext
from statemachine.sequence import Sequence
from statemachine.step import Failure, OnFailure, Outcome, Policy, Step

NAMES = ["drive_to_target", "board_photo", "laser_sweep", "reconstruct", "invert_pose", "place"]
POLICY = Policy(
    (
        Step("drive_to_target", 180.0, 1, ("DeadlineError",)),
        Step("board_photo", 60.0, 2, ("DeadlineError",)),
        Step("laser_sweep", 120.0, 2, ("DeadlineError",)),
        Step("reconstruct", 60.0, on_wall=True),
        Step("invert_pose", 60.0, on_wall=True),
        Step("place", 180.0, on_failure=OnFailure.STOP),
    )
)


class Bench:
    """A runner on a journal in a folder, whose steps are set by the test; it notes what happened, in order."""

    def __init__(self, folder, **steps):
        self.folder = folder
        self.log = []
        self.stopped = threading.Event()
        self.events = []
        self.on_stop = lambda: None
        work = {name: self._step(name, steps.get(name)) for name in NAMES}
        self.runner = Runner(
            sequence=Sequence(tuple(NAMES)),
            steps=work,
            policy=replace(POLICY, grace_s=1.0, stop_deadline_s=1.0),
            journal=Journal(folder, "r1"),
            clock=Clock(),
            classify=self.classify,
            safe_stop=self.safe_stop,
            observer=self.events.append,
        )

    def _step(self, name, work):
        def step(context):
            self.log.append(name)
            return work(context) if work is not None else f"made by {name}"

        return step

    def classify(self, error):
        if isinstance(error, ValueError):
            return Failure(Outcome.REFUSED, str(error), "refused")
        return Failure(
            Outcome.FAULTED,
            str(error),
            "fault",
            recoverable=isinstance(error, ConnectionError),
            needs_person=isinstance(error, ConnectionRefusedError),
        )

    def safe_stop(self, reason):
        self.on_stop()
        self.log.append(f"stop: {reason}")
        self.stopped.set()

    def policy(self, *args, **values):
        self.runner.policy = self.runner.policy.with_step(Step(*args, **values))
        return self

    def run(self, done=None):
        result = self.runner.run(done)
        self.record = read(self.folder)
        assert self.log[-1].startswith("stop: end of the run"), "the last thing is always the safe stop"
        assert sum(line.startswith("stop: end of the run") for line in self.log) == 1
        assert self.record.run.outcome == result.outcome.value
        assert self.runner.sequence.state == result.outcome.value
        return result


def failing(*errors):
    """A step that raises the errors one after the other and then succeeds."""
    left = list(errors)

    def work(context):
        if left:
            raise left.pop(0)
        return f"made in attempt {context.attempt}"

    return work


def test_a_step_has_its_time_on_the_wall_beside_the_cells(tmp_path):
    bench = Bench(tmp_path, laser_sweep=lambda context: bench.runner.clock.sleep(2.0))
    bench.runner.clock = Clock(rate=20.0)
    (sweep,) = (record for record in bench.run().steps if record.name == "laser_sweep")
    assert sweep.duration_s >= 2.0
    assert sweep.wall_s == pytest.approx(sweep.duration_s / 20.0, rel=0.05)


def test_all_steps_run_in_order_and_the_run_ends_placed(tmp_path):
    bench = Bench(tmp_path)
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    assert bench.log[:-1] == NAMES
    assert [(record.name, record.state, record.retries) for record in result.steps] == [(n, "done", 0) for n in NAMES]
    assert bench.record.finished
    assert list(bench.record.done) == NAMES


def test_a_step_sees_what_the_earlier_ones_made(tmp_path):
    seen = {}
    bench = Bench(tmp_path, laser_sweep=lambda context: seen.update(context.results))
    bench.run()
    assert seen == {
        "drive_to_target": "made by drive_to_target",
        "board_photo": "made by board_photo",
    }


def test_the_summary_of_a_result_is_in_the_journal(tmp_path):
    class Photo:
        def summary(self):
            return {"residual_px": 0.08}

    bench = Bench(tmp_path, board_photo=lambda context: Photo())
    bench.run()
    assert bench.record.done["board_photo"] == {"residual_px": 0.08}


def test_a_refusal_ends_the_run_with_its_reason(tmp_path):
    bench = Bench(tmp_path, invert_pose=failing(ValueError("rotation about z is not known well enough")))
    result = bench.run()
    assert result.outcome is Outcome.REFUSED
    assert result.reason == "rotation about z is not known well enough"
    assert "place" not in bench.log
    assert [record.state for record in result.steps] == ["done"] * 4 + ["failed", "open"]


def test_an_unexpected_exception_is_a_fault_and_its_traceback_is_kept(tmp_path):
    bench = Bench(tmp_path, reconstruct=failing(ZeroDivisionError("division by zero")))
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert isinstance(result.error, ZeroDivisionError)
    (trace,) = [event for event in bench.record.events if event.kind == "traceback"]
    assert "ZeroDivisionError" in trace.data["text"]
    assert trace.step == "reconstruct"


def test_a_named_exception_is_retried_from_a_cell_at_rest(tmp_path):
    bench = Bench(tmp_path, board_photo=failing(TimeoutError("no frame"), TimeoutError("no frame")))
    bench.policy("board_photo", 10.0, 2, ("TimeoutError",))
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    assert result.results["board_photo"] == "made in attempt 3"
    assert result.steps[1].retries == 2
    start = bench.log.index("board_photo")
    stops = ["stop: board_photo failed", "stop: before board_photo is tried again"]
    assert bench.log[start : start + 7] == ["board_photo", *stops, "board_photo", *stops, "board_photo"]
    assert [row.state for row in bench.record.steps if row.name == "board_photo"] == ["failed", "failed", "done"]


def test_retries_run_out(tmp_path):
    bench = Bench(tmp_path, board_photo=failing(*[TimeoutError("no frame")] * 5))
    bench.policy("board_photo", 10.0, 2, ("TimeoutError",))
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert bench.log.count("board_photo") == 3


def test_an_exception_that_is_not_named_is_not_retried(tmp_path):
    bench = Bench(tmp_path, board_photo=failing(OSError("broken")))
    bench.policy("board_photo", 10.0, 2, ("TimeoutError",))
    assert bench.run().outcome is Outcome.FAULTED
    assert bench.log.count("board_photo") == 1


def test_a_recoverable_fault_goes_through_recovery_and_back_to_the_step(tmp_path):
    bench = Bench(tmp_path, laser_sweep=failing(ConnectionError("protective stop")))
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.recover = lambda error, token, confirmed: bench.log.append(f"recover: {error}, {confirmed}")
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    start = bench.log.index("laser_sweep")
    again = "stop: recovered, before laser_sweep is tried again"
    assert bench.log[start : start + 5] == [
        "laser_sweep", "stop: laser_sweep failed", "recover: protective stop, False", again, "laser_sweep",
    ]  # fmt: skip
    changes = [(event.data["from"], event.data["to"]) for event in bench.record.events if event.kind == "state"]
    assert changes[3:6] == [
        ("laser_sweep", "faulted"), ("faulted", "recovering"), ("recovering", "laser_sweep"),
    ]  # fmt: skip


def test_what_no_recovery_can_clear_is_not_recovered(tmp_path):
    bench = Bench(tmp_path, laser_sweep=failing(OSError("the emergency stop is pressed")))
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.recover = lambda error, token, confirmed: bench.log.append("recover")
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.FAULTED, "the emergency stop is pressed")
    assert "recover" not in bench.log


def test_a_recovery_that_fails_ends_the_run_with_both_reasons(tmp_path):
    def recover(error, token, confirmed):
        raise OSError("the link is gone")

    bench = Bench(tmp_path, laser_sweep=failing(ConnectionError("protective stop")))
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.recover = recover
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert "protective stop" in result.reason
    assert "the link is gone" in result.reason


def test_a_step_whose_policy_is_to_stop_is_not_recovered(tmp_path):
    bench = Bench(tmp_path, place=failing(ConnectionError("protective stop")))
    bench.policy("place", 10.0, 1, on_failure=OnFailure.STOP)
    bench.runner.recover = lambda error, token, confirmed: bench.log.append("recover")
    assert bench.run().outcome is Outcome.FAULTED
    assert "recover" not in bench.log


def test_a_step_that_overruns_is_stopped_and_named(tmp_path):
    bench = Bench(tmp_path, laser_sweep=lambda context: bench.stopped.wait(5))
    bench.policy("laser_sweep", 0.05)
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert "laser_sweep did not end within its deadline" in result.reason
    assert result.code == "step.deadline"


def test_a_step_that_only_reports_progress_learns_that_it_is_to_end(tmp_path):
    def work(context):
        while True:
            context.progress(0.5, "going through what has piled up")

    bench = Bench(tmp_path, laser_sweep=work)
    bench.policy("laser_sweep", 0.05)
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert "still busy" not in result.reason


def test_an_overrun_can_be_retried(tmp_path):
    def work(context):
        if context.attempt == 1:
            while True:
                context.check()
        return

    bench = Bench(tmp_path, laser_sweep=work).policy("laser_sweep", 0.05, 1, ("StepOverrun",))
    assert bench.run().outcome is Outcome.PLACED


def test_a_step_that_does_not_end_even_after_the_stop_is_left_behind_and_not_repeated(tmp_path):
    release = threading.Event()
    bench = Bench(tmp_path, laser_sweep=lambda context: release.wait(20))
    bench.policy("laser_sweep", 0.05, 3, ("StepOverrun",))
    bench.runner.policy = replace(bench.runner.policy, grace_s=0.1)
    result = bench.run()
    release.set()
    assert result.outcome is Outcome.FAULTED
    assert "still busy 0.1 s after the stop" in result.reason
    assert bench.log.count("laser_sweep") == 1


def test_a_computing_step_has_its_deadline_on_the_wall(tmp_path):
    left = {}
    bench = Bench(
        tmp_path,
        laser_sweep=lambda context: left.update(moving=context.remaining()),
        reconstruct=lambda context: left.update(computing=context.remaining()),
    )
    bench.runner.clock = Clock(rate=10)
    bench.policy("laser_sweep", 60.0).policy("reconstruct", 60.0, on_wall=True)
    bench.run()
    assert left["moving"] == pytest.approx(60, abs=10)
    assert left["computing"] == pytest.approx(600, abs=10)


def test_an_abort_from_another_thread_stops_the_moving_step(tmp_path):
    def work(context):
        bench.runner.control.abort("the operator has seen enough")
        assert bench.stopped.wait(5), "the cell is stopped while the step still runs"
        raise OSError("the motion was stopped")

    bench = Bench(tmp_path, laser_sweep=work)
    result = bench.run()
    assert result.outcome is Outcome.ABORTED
    assert result.reason == "the operator has seen enough"
    assert "reconstruct" not in bench.log


def test_another_process_can_abort_through_the_journal(tmp_path):
    def work(context):
        request(tmp_path, "abort", "cell abort")
        bench.stopped.wait(5)

    bench = Bench(tmp_path, board_photo=work)
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.ABORTED, "cell abort")


def test_a_paused_run_waits_before_its_next_step_and_goes_on(tmp_path):
    def observe(event):
        if event.kind == "state" and event.data["to"] == "paused":
            bench.log.append("paused")
            request(tmp_path, "go-on", "")

    bench = Bench(tmp_path, board_photo=lambda context: bench.runner.control.pause())
    bench.runner.observer = observe
    assert bench.run().outcome is Outcome.PLACED
    assert bench.log[:4] == ["drive_to_target", "board_photo", "paused", "laser_sweep"]
    assert [event.data["text"] for event in bench.record.events if event.kind == "going_on"] == ["goes on"]


def test_a_paused_run_can_be_aborted(tmp_path):
    def observe(event):
        if event.kind == "state" and event.data["to"] == "paused":
            bench.runner.control.abort("enough")

    bench = Bench(tmp_path, board_photo=lambda context: bench.runner.control.pause())
    bench.runner.observer = observe
    result = bench.run()
    assert (result.outcome, result.faults) == (Outcome.ABORTED, ())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_end_stops_the_moving_step(tmp_path, number):
    def work(context):
        os.kill(os.getpid(), number)
        assert bench.stopped.wait(5), "the cell is stopped while the step still runs"

    bench = Bench(tmp_path, laser_sweep=work)
    with outlived(number):
        result = bench.run()
    assert result.outcome is Outcome.ABORTED
    assert result.signal == number
    assert "reconstruct" not in bench.log


@contextmanager
def outlived(number):
    """A signal that the runner does not take fails the test in here, and does not end pytest."""
    before = signal.signal(number, lambda number, frame: None)
    try:
        yield
    finally:
        signal.signal(number, before)


def test_ill_health_ends_the_step_whatever_it_does(tmp_path):
    def health():
        if bench.log[-1:] == ["laser_sweep"]:
            raise ValueError("the vehicle reports a fault")

    bench = Bench(tmp_path, laser_sweep=lambda context: bench.stopped.wait(5))
    bench.runner.health = health
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "the vehicle reports a fault")
    assert [record.name for record in result.steps if record.state == "failed"] == ["laser_sweep"]


def test_what_ails_the_cell_is_written_down_once_it_stands(tmp_path):
    """A disk that stalls must not keep the arm moving."""

    def health():
        if bench.log[-1:] == ["laser_sweep"]:
            raise ValueError("the vehicle reports a fault")

    def event(kind, *rest):
        if kind == "traceback":
            bench.log.append("written")
        write(kind, *rest)

    bench = Bench(tmp_path, laser_sweep=lambda context: bench.stopped.wait(5))
    write, bench.runner.journal.event = bench.runner.journal.event, event
    bench.runner.health = health
    assert bench.run().reason == "the vehicle reports a fault"
    assert bench.log[3:5] == ["stop: the vehicle reports a fault", "written"]


def test_an_ailing_cell_is_found_before_an_attempt_begins(tmp_path):
    def health():
        raise ValueError("the emergency stop is pressed")

    bench = Bench(tmp_path)
    bench.runner.health = health
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "the emergency stop is pressed")
    assert "drive_to_target" not in bench.log


def test_a_fault_while_the_run_is_held_is_recovered_and_the_run_is_held_again(tmp_path):
    ails = threading.Event()
    log = []

    def health():
        if ails.is_set():
            raise ConnectionError("protective stop")

    def pause(context):
        bench.runner.control.pause()
        ails.set()

    def recover(error, token, confirmed):
        ails.clear()
        log.append(bench.log.count("laser_sweep"))
        threading.Timer(0.2, go_on).start()

    def go_on():
        log.append(bench.log.count("laser_sweep"))
        bench.runner.control.go_on()

    bench = Bench(tmp_path, board_photo=pause)
    bench.runner.health, bench.runner.recover = health, recover
    # board_photo ends before its health is looked at again.
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    assert log == [0, 0], "nothing began while the run was to be held"
    assert [(fault.step, fault.remedy) for fault in result.faults] == [("laser_sweep", "recovered")]
    assert sum(event.kind == "paused" for event in bench.events) == 2
    texts = [event.data["text"] for event in bench.events if event.kind == "going_on"]
    assert texts == ["held no longer: protective stop", "goes on"]


def test_a_summary_that_fails_does_not_undo_what_was_done(tmp_path):
    class Photo:
        def summary(self):
            raise ZeroDivisionError("no dots")

    bench = Bench(tmp_path, place=lambda context: Photo())
    assert bench.run().outcome is Outcome.PLACED
    assert bench.record.done["place"] == {"summary_missing": "ZeroDivisionError: no dots"}


def test_who_asks_for_the_end_as_a_run_comes_to_a_good_one_is_not_lost(tmp_path):
    bench = Bench(tmp_path)
    stop = bench.runner.safe_stop

    def asked_meanwhile(reason):
        bench.runner.control.abort("Cell.stop()")
        stop(reason)

    bench.runner.safe_stop = asked_meanwhile
    assert bench.run().outcome is Outcome.PLACED
    assert bench.runner.control.late


def test_who_asks_for_the_end_after_the_last_step_and_before_the_end_is_late(tmp_path):
    def observe(event):
        if event.data.get("to") == "placed":
            bench.runner.control.abort("Cell.stop()")

    bench = Bench(tmp_path)
    bench.runner.observer = observe
    assert bench.run().outcome is Outcome.PLACED
    assert bench.runner.control.late


def test_who_ended_a_run_did_not_come_late(tmp_path):
    bench = Bench(tmp_path, board_photo=lambda context: bench.runner.control.abort("enough"))
    assert bench.run().outcome is Outcome.ABORTED
    assert not bench.runner.control.late


def test_ctrl_c_aborts_and_a_second_one_does_not_cut_the_safe_stop_short(tmp_path):
    def work(context):
        os.kill(os.getpid(), signal.SIGINT)
        bench.stopped.wait(5)

    def safe_stop(reason):
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGINT)
        bench.safe_stop(reason)

    before = signal.getsignal(signal.SIGINT)
    bench = Bench(tmp_path, laser_sweep=work)
    bench.runner.safe_stop = safe_stop
    result = bench.run()
    assert result.outcome is Outcome.ABORTED
    assert result.reason == "interrupted from the keyboard"
    assert result.signal == signal.SIGINT
    assert signal.getsignal(signal.SIGINT) is before


def test_a_safe_stop_that_fails_makes_the_run_faulted(tmp_path):
    def safe_stop(reason):
        bench.safe_stop(reason)
        raise OSError("the laser is still on")

    bench = Bench(tmp_path)
    bench.runner.safe_stop = safe_stop
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert "the laser is still on" in result.reason


def test_a_safe_stop_that_ends_too_late_makes_the_run_faulted(tmp_path):
    bench = Bench(tmp_path)
    bench.runner.policy = replace(bench.runner.policy, stop_deadline_s=0.2)
    bench.on_stop = lambda: bench.runner.clock.sleep(0.6)
    result = bench.runner.run()
    assert result.outcome is Outcome.FAULTED
    assert "did not end within 0.2 s" in result.reason


def test_a_safe_stop_that_takes_its_time_is_waited_for(tmp_path):
    bench = Bench(tmp_path)
    bench.on_stop = lambda: time.sleep(0.4)
    assert bench.run().outcome is Outcome.PLACED


def test_a_resumed_run_does_only_what_is_open(tmp_path):
    bench = Bench(tmp_path, laser_sweep=lambda context: context.results["board_photo"] + "!")
    result = bench.run(done={"drive_to_target": None, "board_photo": "stored"})
    assert bench.log[0] == "laser_sweep"
    assert result.results["laser_sweep"] == "stored!"
    assert [record.state for record in result.steps[:3]] == ["resumed", "resumed", "done"]


def test_a_journal_that_fails_ends_the_run_safe(tmp_path):
    bench = Bench(tmp_path, laser_sweep=lambda context: bench.runner.journal.close())
    result = bench.runner.run()
    assert result.outcome is Outcome.FAULTED
    assert "journal" in result.reason
    assert bench.log[-1].startswith("stop: end of the run")
    assert "reconstruct" not in bench.log


class StallingDisk:
    """Another connection that holds the journal's file: whoever writes waits until it lets go."""

    def __init__(self, folder):
        self._base = sqlite3.connect(folder / FILE_NAME, isolation_level=None, check_same_thread=False)

    def stall(self):
        self._base.execute("BEGIN IMMEDIATE")
        self.since = time.monotonic()

    def go_on(self):
        if self._base.in_transaction:
            self._base.execute("ROLLBACK")

    def stall_until_stopped(self, bench):
        """Stall now; the first stop ends it and gives how long it came after the stall's beginning in `waited`."""

        def on_stop():
            bench.waited.append(time.monotonic() - self.since)
            self.go_on()

        bench.waited = []
        bench.on_stop = on_stop
        self.stall()


@pytest.mark.parametrize("error", [OSError("the arm is gone"), ConnectionError("the link is lost")])
def test_a_disk_that_stalls_does_not_hold_up_the_stop_after_a_failed_step(tmp_path, error):
    def work(context):
        if context.attempt == 1:
            disk.stall_until_stopped(bench)
            raise error

    bench = Bench(tmp_path, laser_sweep=work)
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.recover = lambda error, token, confirmed: None
    disk = StallingDisk(tmp_path)
    bench.run()
    assert bench.waited[0] < 0.5
    assert next(row.state for row in bench.record.steps if row.name == "laser_sweep") == "failed"


def test_a_step_that_waits_for_the_disk_is_watched_all_the_same(tmp_path):
    def work(context):
        disk.stall_until_stopped(bench)
        context.note(lost_frames=2)
        context.token.event.wait(5)

    bench = Bench(tmp_path, laser_sweep=work)
    bench.policy("laser_sweep", 0.3)
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


def test_the_start_of_a_step_is_in_the_journal_before_it_acts(tmp_path):
    seen = []
    bench = Bench(tmp_path, laser_sweep=lambda context: seen.append(read(tmp_path).steps[-1]))
    bench.run()
    assert (seen[0].name, seen[0].state) == ("laser_sweep", "running")


def test_an_observer_that_fails_does_not_end_the_job(tmp_path):
    def observe(event):
        raise OSError("the terminal is gone")

    bench = Bench(tmp_path)
    bench.runner.observer = observe
    assert bench.run().outcome is Outcome.PLACED
    assert any(event.kind == "observer_failed" for event in bench.record.events)


def test_progress_and_notes_reach_the_observer_and_only_notes_the_journal(tmp_path):
    def work(context):
        context.progress(0.5, "half")
        context.note(lost_frames=2)

    bench = Bench(tmp_path, laser_sweep=work)
    bench.run()
    told = [(event.kind, dict(event.data)) for event in bench.events if event.step == "laser_sweep"]
    assert ("progress", {"fraction": 0.5, "text": "half"}) in told
    assert ("note", {"lost_frames": 2}) in told
    kinds = {event.kind for event in bench.record.events}
    assert "note" in kinds
    assert "progress" not in kinds


def test_a_runner_without_work_for_a_step_is_refused(tmp_path):
    bench = Bench(tmp_path)
    with pytest.raises(ValueError, match="no work was given for place"):
        Runner(
            Sequence(tuple(NAMES)), {name: print for name in NAMES if name != "place"}, POLICY,
            bench.runner.journal, Clock(), bench.classify, bench.safe_stop,
        )  # fmt: skip


# --- one authority for every ending ---


def test_an_abort_while_the_cell_recovers_ends_the_recovery_before_it_begins_anything(tmp_path):
    begun = []

    def recover(error, token, confirmed):
        bench.runner.control.abort("enough")
        assert token.event.wait(5)
        token.check()
        begun.append("unlocked and started")

    bench = Bench(tmp_path, laser_sweep=failing(ConnectionError("link lost")))
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.recover = recover
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.ABORTED, "enough")
    assert begun == []


def test_an_abort_while_a_step_computes_ends_the_run_and_no_step_follows(tmp_path):
    def work(context):
        bench.runner.control.abort("Cell.stop() was called")
        return "a result that comes too late"

    bench = Bench(tmp_path, reconstruct=work)
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.ABORTED, "Cell.stop() was called")
    assert "invert_pose" not in bench.log


def test_what_a_step_leaves_behind_is_ended_with_it(tmp_path):
    tokens = {}
    bench = Bench(tmp_path, board_photo=lambda context: tokens.update({context.attempt: context.token}))
    bench.run()
    assert tokens[1].reason == "board_photo has ended"


def test_a_recovery_that_does_not_end_is_cut_short(tmp_path):
    bench = Bench(tmp_path, board_photo=failing(ConnectionError("link lost"))).policy("board_photo", 5.0, 1)
    bench.runner.policy = replace(bench.runner.policy, recovery_deadline_s=0.2)

    def recover(error, token, confirmed):
        assert token.event.wait(3.0)
        token.check()

    bench.runner.recover = recover
    begun = time.monotonic()
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert "the recovery did not end within its deadline" in result.reason
    assert time.monotonic() - begun < 2.0


def test_past_its_deadline_a_step_has_no_time_left():
    context = StepContext(POLICY.of("place"), 1, 0.0, {}, Clock(), lambda event: None)
    assert context.remaining() == 0.0


def test_a_fault_that_needs_a_person_waits_for_the_word_and_only_then_recovers(tmp_path):
    def observe(event):
        if event.kind == "confirm_needed":
            bench.log.append("asked")
            request(tmp_path, "confirm", "Ann", event.data["number"])

    bench = Bench(tmp_path, laser_sweep=failing(ConnectionRefusedError("protective stop")))
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.observer = observe
    bench.runner.recover = lambda error, token, confirmed: bench.log.append(f"recover, confirmed: {confirmed}")
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    start = bench.log.index("laser_sweep")
    again = "stop: recovered, before laser_sweep is tried again"
    assert bench.log[start : start + 6] == [
        "laser_sweep", "stop: laser_sweep failed", "asked", "recover, confirmed: True", again, "laser_sweep",
    ]  # fmt: skip
    (fault,) = result.faults
    assert (fault.step, fault.attempt, fault.code) == ("laser_sweep", 1, "fault")
    assert fault.remedy == "confirmed by Ann, recovered"


def test_an_emergency_stop_ends_the_wait_for_a_persons_word(tmp_path):
    def health():
        if pressed.is_set():
            raise OSError("the emergency stop is pressed")
        if bench.log[-1:] == ["stop: laser_sweep failed"]:
            raise ConnectionRefusedError("protective stop")

    def observe(event):
        if event.kind == "confirm_needed":
            pressed.set()

    pressed = threading.Event()
    bench = Bench(tmp_path, laser_sweep=failing(ConnectionRefusedError("protective stop")))
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.policy = replace(bench.runner.policy, confirm_deadline_s=5.0)
    bench.runner.observer, bench.runner.health = observe, health
    bench.runner.recover = lambda error, token, confirmed: bench.log.append("recover")
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.FAULTED, "the emergency stop is pressed")
    assert "recover" not in bench.log
    assert not bench.runner.control.confirm("too late")


def test_nobody_confirms_and_the_run_ends_without_a_recovery(tmp_path):
    bench = Bench(tmp_path, laser_sweep=failing(ConnectionRefusedError("protective stop")))
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.policy = replace(bench.runner.policy, confirm_deadline_s=0.1)
    bench.runner.recover = lambda error, token, confirmed: bench.log.append("recover")
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert "nobody confirmed within 0.1 s" in result.reason
    assert "recover" not in bench.log


def test_a_pause_holds_the_step_at_its_next_safe_point_and_its_deadline_waits_too(tmp_path):
    def observe(event):
        if event.kind == "paused":
            threading.Timer(0.4, bench.runner.control.go_on).start()

    def work(context):
        bench.runner.control.pause()
        context.safe_point()
        bench.log.append("went on")

    bench = Bench(tmp_path, laser_sweep=work)
    bench.policy("laser_sweep", 0.2)
    bench.runner.observer = observe
    result = bench.run()
    assert result.outcome is Outcome.PLACED, result.reason
    assert "went on" in bench.log
    assert {"paused", "going_on"} <= {event.kind for event in bench.record.events}


def test_a_step_that_is_held_can_be_aborted(tmp_path):
    def observe(event):
        if event.kind == "paused":
            bench.runner.control.abort("enough")

    def work(context):
        bench.runner.control.pause()
        context.safe_point()
        bench.log.append("went on")

    bench = Bench(tmp_path, laser_sweep=work)
    bench.runner.observer = observe
    assert bench.run().outcome is Outcome.ABORTED
    assert "went on" not in bench.log


def test_every_fault_and_repetition_is_in_the_result(tmp_path):
    bench = Bench(
        tmp_path,
        drive_to_target=lambda context: context.fault("vehicle.motor_fault", "motor 2 is too hot"),
        board_photo=failing(TimeoutError("no frame")),
        invert_pose=failing(ValueError("not observable")),
    )
    bench.policy("board_photo", 10.0, 1, ("TimeoutError",))
    result = bench.run()
    assert [(f.step, f.code, f.remedy) for f in result.faults] == [
        ("drive_to_target", "vehicle.motor_fault", "noted"),
        ("board_photo", "fault", "tried again"),
        ("invert_pose", "refused", "ended the run"),
    ]


def test_nothing_is_tried_again_on_a_cell_of_which_it_is_not_known_that_it_stands(tmp_path):
    def safe_stop(reason):
        bench.safe_stop(reason)
        if reason.startswith("before"):
            raise OSError("vehicle stopped and braked: not confirmed")

    bench = Bench(tmp_path, board_photo=failing(TimeoutError("no frame")))
    bench.policy("board_photo", 10.0, 2, ("TimeoutError",))
    bench.runner.safe_stop = safe_stop
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert result.code == "safe_stop"
    assert "no frame" in result.reason
    assert "not confirmed" in result.reason
    assert bench.log.count("board_photo") == 1


def test_a_script_goes_back_only_in_a_cell_that_is_known_to_stand(tmp_path):
    def safe_stop(reason):
        bench.safe_stop(reason)
        if reason.startswith("before"):
            raise OSError("vehicle stopped and braked: not confirmed")

    bench = Bench(tmp_path, board_photo=failing(ValueError("no board")))
    bench.runner.safe_stop = safe_stop
    bench.runner.script = Script(on_refusal=lambda step, failure: Again("board_photo", "wiped the lens"))
    result = bench.run()
    assert (result.outcome, result.code) == (Outcome.FAULTED, "safe_stop")
    assert bench.log.count("board_photo") == 1


def test_a_script_that_looks_or_decides_is_not_idle():
    assert Script().idle
    assert not Script(after={"place": print}).idle
    assert not Script(on_refusal=lambda step, failure: None).idle


def test_a_failure_that_cannot_be_classified_is_a_fault(tmp_path):
    def classify(error):
        raise KeyError("no such kind")

    bench = Bench(tmp_path, board_photo=failing(ValueError("no board")))
    bench.runner.classify = classify
    result = bench.run()
    assert (result.outcome, result.code) == (Outcome.FAULTED, "run.internal")
    assert "no board" in result.reason
    assert "no such kind" in result.reason


def test_after_a_recovery_the_cell_has_to_be_known_to_stand_before_the_step_is_tried_again(tmp_path):
    def safe_stop(reason):
        bench.safe_stop(reason)
        if reason.startswith("recovered"):
            raise OSError("arm stopped: not confirmed")

    bench = Bench(tmp_path, laser_sweep=failing(ConnectionError("link lost")))
    bench.policy("laser_sweep", 10.0, 1)
    bench.runner.recover = lambda error, token, confirmed: None
    bench.runner.safe_stop = safe_stop
    result = bench.run()
    assert result.outcome is Outcome.FAULTED
    assert "arm stopped: not confirmed" in result.reason
    assert bench.log.count("laser_sweep") == 1


def test_a_signal_after_the_end_of_the_run_is_kept(tmp_path):
    bench = Bench(tmp_path)
    bench.run()
    bench.runner.control.abort("interrupted from the keyboard", signal.SIGINT)
    assert bench.runner.control.signal == signal.SIGINT


def test_a_word_of_another_process_counts_for_the_question_that_it_names_and_no_other(tmp_path):
    journal, control = Journal(tmp_path, "r1"), RunControl()
    first = control.ask("protective stop in the sweep")
    with pytest.raises(ValueError, match="number of its question"):
        request(tmp_path, "confirm", "Ann")
    request(tmp_path, "confirm", "Ann", first)
    control.asked_no_more()
    second = control.ask("protective stop while placing")
    control.obey(journal.take_requests())
    assert control.answer() is None, "what was said about the first comes after the second was asked"
    request(tmp_path, "confirm", "Bob", second)
    control.obey(journal.take_requests())
    assert control.answer() == "Bob"


def alone(folder, work=None):
    """A bench whose runner has one step, which others' run goes on after."""
    bench = Bench(folder, place=work)
    bench.runner.sequence = Sequence(("place",))
    return bench


def test_a_step_alone_that_succeeds_leaves_the_cell_and_the_run_as_they_are(tmp_path):
    bench = alone(tmp_path)
    result = bench.runner.run_alone()
    assert (result.made, result.end) == ("made by place", None)
    assert bench.log == ["place"]
    assert not bench.runner.control.over


def test_after_a_step_alone_that_fails_the_cell_is_brought_to_rest_once(tmp_path):
    bench = alone(tmp_path, failing(ValueError("no")))
    result = bench.runner.run_alone()
    assert (result.end.outcome, result.end.reason, str(result.error)) == (Outcome.REFUSED, "no", "no")
    assert bench.log == ["place", "stop: place failed"]


def test_who_asks_for_the_end_just_after_a_step_alone_has_the_cell_brought_to_rest(tmp_path):
    bench = alone(tmp_path)
    control = bench.runner.control
    bench.runner.observer = lambda event: event.kind == "step_done" and control.abort("by a person")
    assert bench.runner.run_alone().end.outcome is Outcome.ABORTED
    assert bench.log == ["place", "stop: by a person"]


def test_a_recovery_that_fails_alone_is_stopped_after(tmp_path):
    """The stop of the failed attempt came before it: what the recovery began is not at rest."""
    bench = alone(tmp_path, failing(ConnectionError("lost")))
    bench.policy("place", 5.0, 1)
    bench.runner.recover = lambda error, token, confirmed: failing(OSError("jammed"))(None)
    result = bench.runner.run_alone()
    assert "the recovery failed: jammed" in result.end.reason
    assert [line.split(":")[0] for line in bench.log] == ["place", "stop", "stop"]
