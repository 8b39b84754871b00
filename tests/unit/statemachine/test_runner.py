"""The runner: every run ends safe, with the outcome that its steps deserve, and everything is in the journal."""

import signal
import threading

import pytest

from drivers.clock import Clock
from statemachine.journal import JournalError, read
from statemachine.runner import Again, Runner, Script
from statemachine.sequence import Sequence
from statemachine.step import Outcome
from tests.support.runner_bench import NAMES, POLICY, Bench, failing


def test_a_step_has_its_time_on_the_wall_beside_the_cells(tmp_path):
    bench = Bench(tmp_path, clock=Clock(rate=20.0), laser_sweep=lambda context: bench.runner.clock.sleep(2.0))
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


def test_a_step_sees_what_the_earlier_ones_made_and_nothing_goes_on_after_it(tmp_path):
    seen, tokens = {}, []
    bench = Bench(
        tmp_path, board_photo=lambda context: tokens.append(context.token),
        laser_sweep=lambda context: seen.update(context.results),
    )  # fmt: skip
    bench.run()
    assert seen == {"drive_to_target": "made by drive_to_target", "board_photo": None}
    assert tokens[0].reason == "board_photo has ended"


class Photo:
    """A result with figures, or none."""

    def __init__(self, figures):
        self.figures = figures

    def summary(self):
        return {"residual_px": self.figures[0]}


@pytest.mark.parametrize(
    ("figures", "kept"),
    [([0.08], {"residual_px": 0.08}), ([], {"summary_missing": "IndexError: list index out of range"})],
)
def test_the_summary_of_a_result_is_in_the_journal_and_one_that_fails_undoes_nothing(tmp_path, figures, kept):
    bench = Bench(tmp_path, board_photo=lambda context: Photo(figures))
    assert bench.run().outcome is Outcome.PLACED
    assert bench.record.done["board_photo"] == kept


def test_a_refusal_ends_the_run_with_its_reason(tmp_path):
    bench = Bench(tmp_path, invert_pose=failing(ValueError("rotation about z is not known well enough")))
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "rotation about z is not known well enough")
    assert "place" not in bench.log
    assert [record.state for record in result.steps] == ["done"] * 4 + ["failed", "open"]


def test_an_unexpected_exception_is_a_fault_and_its_traceback_is_kept(tmp_path):
    bench = Bench(tmp_path, reconstruct=failing(ZeroDivisionError("division by zero")))
    result = bench.run()
    assert result.outcome is Outcome.FAULTED and isinstance(result.error, ZeroDivisionError)
    (trace,) = [event for event in bench.record.events if event.kind == "traceback"]
    assert "ZeroDivisionError" in trace.data["text"]
    assert trace.step == "reconstruct"


def test_every_fault_and_repetition_is_in_the_result(tmp_path):
    bench = Bench(
        tmp_path, drive_to_target=lambda context: context.fault("vehicle.motor_fault", "motor 2 is too hot"),
        board_photo=failing(TimeoutError("no frame")), invert_pose=failing(ValueError("not observable")),
    )  # fmt: skip
    result = bench.policy("board_photo", 10.0, 1, ("TimeoutError",)).run()
    assert [(f.step, f.code, f.remedy) for f in result.faults] == [
        ("drive_to_target", "vehicle.motor_fault", "noted"),
        ("board_photo", "fault", "tried again"),
        ("invert_pose", "refused", "ended the run"),
    ]


@pytest.mark.parametrize("stopping", [True, False])
def test_who_asks_for_the_end_after_the_last_step_or_as_the_run_ends_well_is_late_and_not_lost(tmp_path, stopping):
    bench = Bench(tmp_path)
    if stopping:
        bench.on_stop = lambda: bench.control.abort("Cell.stop()")
    else:
        bench.runner.observer = lambda event: event.data.get("to") == "placed" and bench.control.abort("Cell.stop()")
    assert bench.run().outcome is Outcome.PLACED and bench.control.late


def test_who_ended_a_run_did_not_come_late(tmp_path):
    bench = Bench(tmp_path, board_photo=lambda context: bench.control.abort("enough"))
    assert bench.run().outcome is Outcome.ABORTED and not bench.control.late


def test_a_signal_after_the_end_of_the_run_is_kept(tmp_path):
    bench = Bench(tmp_path)
    bench.run()
    bench.control.abort("interrupted from the keyboard", signal.SIGINT)
    assert bench.control.signal == signal.SIGINT


def test_a_journal_that_fails_ends_the_run_safe(tmp_path):
    bench = Bench(tmp_path, laser_sweep=lambda context: bench.runner.journal.close())
    result = bench.runner.run()
    assert result.outcome is Outcome.FAULTED
    assert "journal" in result.reason
    assert bench.log[-1].startswith("stop: end of the run")
    assert "reconstruct" not in bench.log


def test_the_start_of_a_step_is_in_the_journal_before_it_acts(tmp_path):
    seen = []
    Bench(tmp_path, laser_sweep=lambda context: seen.append(read(tmp_path).steps[-1])).run()
    assert (seen[0].name, seen[0].state) == ("laser_sweep", "running")


def test_an_observer_that_fails_does_not_end_the_job(tmp_path):
    bench = Bench(tmp_path, observer=lambda event: {}["the terminal is gone"])
    assert bench.run().outcome is Outcome.PLACED
    assert any(event.kind == "observer_failed" for event in bench.record.events)


def test_progress_and_notes_reach_the_observer_and_only_notes_the_journal(tmp_path):
    bench = Bench(tmp_path, laser_sweep=lambda context: (context.progress(0.5, "half"), context.note(lost_frames=2)))
    bench.run()
    assert bench.told("progress") == [{"fraction": 0.5, "text": "half"}]
    assert bench.told("note") == [{"lost_frames": 2}]
    kinds = {event.kind for event in bench.record.events}
    assert "note" in kinds
    assert "progress" not in kinds


def test_a_runner_without_work_for_a_step_is_refused(tmp_path):
    bench, steps = Bench(tmp_path), {name: print for name in NAMES if name != "place"}
    with pytest.raises(ValueError, match="no work was given for place"):
        Runner(
            Sequence(tuple(NAMES)), steps, POLICY, bench.runner.journal, Clock(),
            classify=bench.classify, safe_stop=bench.safe_stop,
        )  # fmt: skip


# --- what a script does between the steps ---


def test_a_script_that_looks_or_decides_is_not_idle():
    assert Script().idle and not Script(after={"place": print}).idle
    assert not Script(on_refusal=lambda step, failure: None).idle


def refusing(folder, times, chosen, error=ValueError, **work):
    """A bench whose sweep fails so many times, and whose script then decides for `chosen`; and what that was asked."""
    asked = []

    def decide(step, failure):
        asked.append((step, failure.reason))
        return chosen

    work = {"laser_sweep": failing(*[error("too few points")] * times), **work}
    return Bench(folder, script=Script(on_refusal=decide), **work), asked


def test_a_script_lets_a_refused_run_go_on_from_an_earlier_step_and_the_reason_is_kept(tmp_path):
    bench, asked = refusing(tmp_path, 1, Again("board_photo", "wiped the lens"))
    result = bench.run()
    assert result.outcome is Outcome.PLACED
    assert asked == [("laser_sweep", "too few points")]
    stops = ["stop: laser_sweep failed", "stop: before board_photo is done again"]
    assert bench.log[1:6] == ["board_photo", "laser_sweep", *stops, "board_photo"]
    assert [(fault.step, fault.remedy) for fault in result.faults] == [("laser_sweep", "again from board_photo")]
    (decided,) = (event for event in bench.record.events if event.kind == "decided")
    assert decided.data == {"reason": "too few points", "again": "board_photo", "why": "wiped the lens"}


def test_what_is_to_be_done_again_is_given_nothing_of_what_came_after_it(tmp_path):
    seen = []
    bench, _ = refusing(
        tmp_path, 0, Again("board_photo", "bumped"), place=failing(ValueError("it has moved")),
        board_photo=lambda context: seen.append(tuple(context.results)),
        invert_pose=lambda context: seen.append(tuple(context.results)),
    )  # fmt: skip
    assert bench.run().outcome is Outcome.PLACED
    assert seen == [tuple(NAMES[:1]), tuple(NAMES[:4])] * 2


def test_a_script_is_asked_about_refusals_alone(tmp_path):
    bench, asked = refusing(tmp_path, 1, Again("board_photo", "whatever it was"), OSError)
    assert bench.run().outcome is Outcome.FAULTED
    assert asked == []


def test_without_a_decision_a_refusal_ends_the_run(tmp_path):
    result = refusing(tmp_path, 1, None)[0].run()
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "too few points")
    assert [fault.remedy for fault in result.faults] == ["ended the run"]


def test_a_decision_for_a_step_that_was_not_reached_ends_the_run(tmp_path):
    result = refusing(tmp_path, 1, Again("place", "hurry"))[0].run()
    assert result.outcome is Outcome.REFUSED
    assert "chose to go on from 'place', allowed: drive_to_target, board_photo, laser_sweep" in result.reason


def test_a_script_that_never_gives_up_is_asked_three_times_about_a_step(tmp_path):
    bench, asked = refusing(tmp_path, 99, Again("board_photo", "once more"))
    result = bench.run()
    assert [step for step, _ in asked] == ["laser_sweep"] * 3
    assert result.outcome is Outcome.REFUSED
    assert "has decided about laser_sweep 3 times, the most allowed" in result.reason


def test_retries_before_a_decision_are_counted_with_those_after_it(tmp_path):
    bench, _ = refusing(tmp_path, 5, Again("laser_sweep", "once more"))
    result = bench.policy("laser_sweep", 5.0, 1, ("ValueError",)).run()
    assert result.outcome is Outcome.PLACED
    # Failed, retried; again: failed, retried; again: failed, retried, done.
    assert [record.retries for record in result.steps] == [0, 0, 3, 0, 0, 0]
    again = [(1, "tried again"), (2, "again from laser_sweep")]
    assert [(fault.attempt, fault.remedy) for fault in result.faults] == [*again, *again, again[0]]


def test_a_script_sees_each_result_before_the_next_step_and_may_refuse(tmp_path):
    seen = []

    def look(result):
        seen.append(result)
        raise ValueError("the photograph is not of this board")

    bench = Bench(tmp_path, script=Script(after={"board_photo": look}))
    result = bench.run()
    assert seen == ["made by board_photo"]
    assert (result.outcome, result.reason) == (Outcome.REFUSED, "the photograph is not of this board")
    assert "laser_sweep" not in bench.log


def test_an_abort_ends_a_run_whose_script_still_ponders(tmp_path):
    def ponder(result):
        bench.control.abort("enough")
        bench.control.token.event.wait(5.0)
        bench.control.token.check()

    bench = Bench(tmp_path, script=Script(after={"board_photo": ponder}))
    result = bench.run()
    assert (result.outcome, result.reason) == (Outcome.ABORTED, "enough")
    assert "laser_sweep" not in bench.log


# --- one step alone, in a run that others begin and end ---


def alone(folder, work=None):
    """A bench whose runner has one step, which others' run goes on after."""
    bench = Bench(folder, place=work)
    bench.runner.sequence = Sequence(("place",))
    return bench


def test_a_step_alone_that_succeeds_leaves_the_cell_and_the_run_as_they_are(tmp_path):
    bench = alone(tmp_path)
    result = bench.runner.run_alone()
    assert (result.made, result.end, result.judged) == ("made by place", None, None)
    assert bench.log == ["place"]
    assert not bench.control.over


def test_after_a_step_alone_that_fails_the_cell_is_brought_to_rest_once(tmp_path):
    bench = alone(tmp_path, failing(ValueError("no")))
    result = bench.runner.run_alone()
    assert (result.end.outcome, result.end.reason, str(result.error)) == (Outcome.REFUSED, "no", "no")
    assert result.judged.reason == "no"
    assert bench.log == ["place", "stop: place failed"]


def test_who_asks_for_the_end_just_after_a_step_alone_has_the_cell_brought_to_rest(tmp_path):
    bench = alone(tmp_path)
    bench.runner.observer = lambda event: event.kind == "step_done" and bench.control.abort("by a person")
    assert bench.runner.run_alone().end.outcome is Outcome.ABORTED
    assert bench.log == ["place", "stop: by a person"]


def test_a_recovery_that_fails_alone_is_stopped_after(tmp_path):
    """The stop of the failed attempt came before it: what the recovery began is not at rest."""
    bench = alone(tmp_path, failing(ConnectionError("lost"))).policy("place", 5.0, 1)
    bench.runner.recover = lambda error, token, confirmed: failing(OSError("jammed"))(None)
    result = bench.runner.run_alone()
    assert "the recovery failed: jammed" in result.end.reason
    assert [line.split(":")[0] for line in bench.log] == ["place", "stop", "stop"]


@pytest.mark.parametrize(("error", "end"), [(None, None), (ValueError("no"), "no")], ids=["done", "failed"])
def test_a_step_alone_ends_as_it_did_though_that_cannot_be_written_down(tmp_path, error, end):
    def work(context):
        bench.runner.journal.close()
        return failing(*[error] if error else [])(context)

    bench = alone(tmp_path, work)
    result = bench.runner.run_alone()
    assert isinstance(result.unrecorded, JournalError)
    assert (result.end and result.end.reason) == end
    assert result.made == (None if error else "made in attempt 1")


def test_a_hold_between_two_steps_counts_as_held(tmp_path):
    """Whoever held the run may have reached in, wherever it stood."""
    bench = Bench(tmp_path, board_photo=lambda context: bench.runner.control.pause())
    threading.Timer(0.4, lambda: bench.runner.control.go_on()).start()
    assert bench.run().outcome is Outcome.PLACED
    assert bench.runner.control.held_s > 0.0
