"""A step is repeated or recovered as its policy says, from a cell that is known to stand; a person is asked first."""

import threading
import time

import pytest

from statemachine.control import RunControl
from statemachine.journal import Journal, request
from statemachine.runner import Again, Script
from statemachine.step import OnFailure, Outcome
from tests.support.runner_bench import Bench, failing


def test_a_named_exception_is_retried_from_a_cell_at_rest(tmp_path):
    bench = Bench(tmp_path, board_photo=failing(TimeoutError("no frame"), TimeoutError("no frame")))
    result = bench.policy("board_photo", 10.0, 2, ("TimeoutError",)).run()
    assert result.outcome is Outcome.PLACED
    assert (result.results["board_photo"], result.steps[1].retries) == ("made in attempt 3", 2)
    start = bench.log.index("board_photo")
    stops = ["stop: board_photo failed", "stop: before board_photo is tried again"]
    assert bench.log[start : start + 7] == ["board_photo", *stops, "board_photo", *stops, "board_photo"]
    assert [row.state for row in bench.record.steps if row.name == "board_photo"] == ["failed", "failed", "done"]
    changes = [(event.data["from"], event.data["to"]) for event in bench.record.events if event.kind == "state"]
    assert changes.count(("board_photo", "board_photo")) == 2


@pytest.mark.parametrize(("error", "tries"), [(TimeoutError("no frame"), 3), (OSError("broken"), 1)])
def test_retries_run_out_and_an_exception_that_is_not_named_has_none(tmp_path, error, tries):
    bench = Bench(tmp_path, board_photo=failing(*[error] * 5)).policy("board_photo", 10.0, 2, ("TimeoutError",))
    assert bench.run().outcome is Outcome.FAULTED
    assert bench.log.count("board_photo") == tries


def test_an_overrun_can_be_retried(tmp_path):
    def work(context):
        while context.attempt == 1:
            context.check()

    bench = Bench(tmp_path, laser_sweep=work).policy("laser_sweep", 0.05, 1, ("StepOverrun",))
    assert bench.run().outcome is Outcome.PLACED


def test_a_recoverable_fault_goes_through_recovery_and_back_to_the_step(tmp_path):
    bench = Bench(tmp_path, laser_sweep=failing(ConnectionError("protective stop"))).recovers()
    assert bench.policy("laser_sweep", 10.0, 1).run().outcome is Outcome.PLACED
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
    bench = Bench(tmp_path, laser_sweep=failing(OSError("the emergency stop is pressed"))).recovers()
    result = bench.policy("laser_sweep", 10.0, 1).run()
    assert (result.outcome, result.reason) == (Outcome.FAULTED, "the emergency stop is pressed")
    assert not bench.recovered


def test_a_step_whose_policy_is_to_stop_is_not_recovered(tmp_path):
    bench = Bench(tmp_path, place=failing(ConnectionError("protective stop"))).recovers()
    assert bench.policy("place", 10.0, 1, on_failure=OnFailure.STOP).run().outcome is Outcome.FAULTED
    assert not bench.recovered


def test_a_recovery_that_fails_ends_the_run_with_both_reasons(tmp_path):
    bench = Bench(tmp_path, laser_sweep=failing(ConnectionError("protective stop")))
    bench.runner.recover = lambda error, token, confirmed: failing(OSError("the link is gone"))(None)
    result = bench.policy("laser_sweep", 10.0, 1).run()
    assert result.outcome is Outcome.FAULTED
    assert "protective stop" in result.reason and "the link is gone" in result.reason


def test_an_abort_while_the_cell_recovers_ends_the_recovery_before_it_begins_anything(tmp_path):
    def recover(error, token, confirmed):
        bench.control.abort("enough")
        assert token.event.wait(5)
        token.check()
        bench.log.append("recover: unlocked and started")

    bench = Bench(tmp_path, laser_sweep=failing(ConnectionError("link lost")), recover=recover)
    result = bench.policy("laser_sweep", 10.0, 1).run()
    assert (result.outcome, result.reason) == (Outcome.ABORTED, "enough")
    assert not bench.recovered


def test_a_recovery_that_does_not_end_is_cut_short(tmp_path):
    def recover(error, token, confirmed):
        assert token.event.wait(3.0)
        token.check()

    bench = Bench(tmp_path, board_photo=failing(ConnectionError("link lost")), recover=recover)
    begun = time.monotonic()
    result = bench.policy("board_photo", 5.0, 1).times(recovery_deadline_s=0.2).run()
    assert result.outcome is Outcome.FAULTED
    assert "the recovery did not end within its deadline" in result.reason
    assert time.monotonic() - begun < 2.0


STANDS = {
    "before a retry": ("before", TimeoutError("no frame"), ("TimeoutError",)),
    "after a recovery": ("recovered", ConnectionError("link lost"), ()),
    "before a script goes back": ("before", ValueError("no board"), ()),
}
"""How the reason of the stop begins that is not confirmed, what the step raises, and what is retried."""


@pytest.mark.parametrize("case", STANDS)
def test_nothing_is_tried_again_on_a_cell_of_which_it_is_not_known_that_it_stands(tmp_path, case):
    unconfirmed, error, retried = STANDS[case]
    bench = Bench(tmp_path, unconfirmed, board_photo=failing(error)).recovers()
    bench.runner.script = Script(on_refusal=lambda step, failure: Again("board_photo", "wiped the lens"))
    result = bench.policy("board_photo", 10.0, 2, retried).run()
    assert (result.outcome, result.code) == (Outcome.FAULTED, "safe_stop")
    assert str(error) in result.reason and "not confirmed" in result.reason
    assert bench.log.count("board_photo") == 1


# --- a person's word ---


def test_a_fault_that_needs_a_person_waits_for_the_word_and_only_then_recovers(tmp_path):
    def observe(event):
        if event.kind == "confirm_needed":
            bench.log.append("asked")
            request(tmp_path, "confirm", "Ann", event.data["number"])

    bench = Bench(tmp_path, laser_sweep=failing(ConnectionRefusedError("protective stop")), observer=observe).recovers()
    result = bench.policy("laser_sweep", 10.0, 1).run()
    assert result.outcome is Outcome.PLACED
    start = bench.log.index("laser_sweep")
    again = "stop: recovered, before laser_sweep is tried again"
    assert bench.log[start : start + 6] == [
        "laser_sweep", "stop: laser_sweep failed", "asked", "recover: protective stop, True", again, "laser_sweep",
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

    pressed = threading.Event()
    bench = Bench(
        tmp_path, laser_sweep=failing(ConnectionRefusedError("protective stop")), health=health,
        observer=lambda event: event.kind == "confirm_needed" and pressed.set(),
    ).recovers()  # fmt: skip
    result = bench.policy("laser_sweep", 10.0, 1).times(confirm_deadline_s=5.0).run()
    assert (result.outcome, result.reason) == (Outcome.FAULTED, "the emergency stop is pressed")
    assert not bench.recovered and not bench.control.confirm("too late")


def test_nobody_confirms_and_the_run_ends_without_a_recovery(tmp_path):
    bench = Bench(tmp_path, laser_sweep=failing(ConnectionRefusedError("protective stop"))).recovers()
    result = bench.policy("laser_sweep", 10.0, 1).times(confirm_deadline_s=0.1).run()
    assert result.outcome is Outcome.FAULTED
    assert "nobody confirmed within 0.1 s" in result.reason
    assert not bench.recovered


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


# --- a run that is held ---


def test_a_paused_run_waits_before_its_next_step_and_goes_on(tmp_path):
    def observe(event):
        if event.kind == "state" and event.data["to"] == "paused":
            bench.log.append("paused")
            request(tmp_path, "go-on", "")

    bench = Bench(tmp_path, board_photo=lambda context: bench.control.pause(), observer=observe)
    assert bench.run().outcome is Outcome.PLACED
    assert bench.log[:4] == ["drive_to_target", "board_photo", "paused", "laser_sweep"]
    assert [event.data["text"] for event in bench.record.events if event.kind == "going_on"] == ["goes on"]


def test_a_paused_run_can_be_aborted(tmp_path):
    def observe(event):
        if event.kind == "state" and event.data["to"] == "paused":
            bench.control.abort("enough")

    result = (bench := Bench(tmp_path, board_photo=lambda context: bench.control.pause(), observer=observe)).run()
    assert (result.outcome, result.faults) == (Outcome.ABORTED, ())


def test_a_fault_while_the_run_is_held_is_recovered_and_the_run_is_held_again(tmp_path):
    ails, log = threading.Event(), []

    def health():
        if ails.is_set():
            raise ConnectionError("protective stop")

    def pause(context):
        bench.control.pause()
        ails.set()

    def recover(error, token, confirmed):
        ails.clear()
        log.append(bench.log.count("laser_sweep"))
        threading.Timer(0.2, go_on).start()

    def go_on():
        log.append(bench.log.count("laser_sweep"))
        bench.control.go_on()

    # board_photo ends before its health is looked at again.
    bench = Bench(tmp_path, board_photo=pause, health=health, recover=recover)
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    assert log == [0, 0], "nothing began while the run was to be held"
    assert [(fault.step, fault.remedy) for fault in result.faults] == [("laser_sweep", "recovered")]
    assert len(bench.told("paused")) == 2
    assert [told["text"] for told in bench.told("going_on")] == ["held no longer: protective stop", "goes on"]


def test_a_pause_holds_the_step_at_its_next_safe_point_and_its_deadline_waits_too(tmp_path):
    def observe(event):
        if event.kind == "paused":
            threading.Timer(0.4, bench.control.go_on).start()

    def work(context):
        bench.control.pause()
        context.safe_point()
        bench.log.append("went on")

    bench = Bench(tmp_path, laser_sweep=work, observer=observe).policy("laser_sweep", 0.2)
    result = bench.run()
    assert result.outcome is Outcome.PLACED, result.reason
    assert "went on" in bench.log
    assert {"paused", "going_on"} <= {event.kind for event in bench.record.events}


def test_a_step_that_is_held_can_be_aborted(tmp_path):
    def work(context):
        bench.control.pause()
        context.safe_point()
        bench.log.append("went on")

    bench = Bench(tmp_path, laser_sweep=work)
    bench.runner.observer = lambda event: event.kind == "paused" and bench.control.abort("enough")
    assert bench.run().outcome is Outcome.ABORTED
    assert "went on" not in bench.log
