"""Work in line on the virtual clock: who waits looks around, what ends work comes out of its wait, after the stop."""

import contextlib
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.devices import stop_cell
from cell.devices.simulated.direct import VirtualCell
from cell.motion.kinematics import HOME
from cell.run.recorded_work import classify
from drivers.clock import Clock
from drivers.errors import Aborted
from statemachine.control import Cancelled, RunControl
from statemachine.journal import Journal, request
from statemachine.runner import Runner, RunResult, StepContext
from statemachine.sequence import JobState, Sequence
from statemachine.step import OnFailure, Policy, Step, StepCall
from statemachine.waiting import InLine, Threads, waiting_on

FAR = HOME + np.array([3.0, 0, 0, 0, 0, 0])


@pytest.fixture
def cell() -> VirtualCell:
    made = VirtualCell(load_config(None), 2)
    made.devices.vehicle.brake()
    return made


def run_step(
    cell: VirtualCell, folder: Path, first: StepCall, control: RunControl | None = None,
    stop: Callable[[], object] = list,
) -> RunResult:  # fmt: skip
    """Run a job whose first step is `first`, which has two seconds, and whose second one does nothing."""
    with closing(Journal(folder, "here")) as journal:
        return Runner(
            sequence=Sequence(("first", "second"), JobState.DONE),
            steps={"first": first, "second": lambda context: None},
            policy=Policy((Step("first", 2.0, on_failure=OnFailure.STOP), Step("second", 2.0))),
            journal=journal,
            clock=cell.clock,
            classify=classify,
            safe_stop=lambda reason: (stop_cell(cell.devices), stop())[0],
            control=control or RunControl(),
        ).run()


def test_a_step_past_its_deadline_is_ended_out_of_its_wait_with_the_arm_stopped(cell: VirtualCell, tmp_path):
    threads: list[str] = []

    def slow(context: StepContext) -> None:
        threads.append(threading.current_thread().name)
        cell.devices.gate.enter(context.token)
        cell.devices.arm.move_joints(FAR, 0.05, 0.5).wait(600.0)

    result = run_step(cell, tmp_path, slow)
    assert (result.outcome.value, result.code) == ("faulted", "step.deadline")
    assert threads == [threading.current_thread().name]
    assert not cell.world.arm.moving
    # Two seconds of its own, then the arm's braking and the safe stops.
    assert 2.0 <= cell.clock.now() < 5.0


def test_a_step_that_catches_its_end_and_goes_on_is_told_again_and_begins_nothing(cell: VirtualCell, tmp_path):
    told: list[str] = []

    def stubborn(context: StepContext) -> None:
        cell.devices.gate.enter(context.token)
        for _ in range(3):
            try:
                cell.clock.sleep(100.0)
            except Cancelled as error:
                told.append(str(error))
        with pytest.raises(Aborted):
            cell.devices.arm.move_joints(FAR, 0.05, 0.5)

    result = run_step(cell, tmp_path, stubborn)
    assert result.code == "step.deadline"
    assert len(told) == 3
    assert cell.clock.now() < 2.0 + 3 * Policy(()).grace_s + 2.0


@pytest.mark.parametrize(("each_s", "outcome"), [(3.0, "done"), (4.0, "faulted")])
def test_a_safe_stop_whose_parts_are_in_time_and_whose_whole_is_not_is_not_confirmed(
    cell: VirtualCell, tmp_path, each_s: float, outcome: str
):
    parts = dict.fromkeys("abc", lambda: cell.clock.sleep(each_s))
    result = run_step(cell, tmp_path, lambda context: None, stop=lambda: waiting_on(cell.clock).each(parts, 5.0))
    assert result.outcome.value == outcome
    assert ("did not end within 10 s" in str(result.reason)) == (outcome == "faulted")


def test_a_request_in_the_journal_is_seen_while_the_step_waits(cell: VirtualCell, tmp_path):
    def asking(context: StepContext) -> None:
        request(tmp_path, "abort", "by another process")
        cell.clock.sleep(100.0)

    result = run_step(cell, tmp_path, asking)
    assert (result.outcome.value, result.reason) == ("aborted", "by another process")
    assert cell.clock.now() < 2.0


def test_held_work_hears_that_it_is_to_end_although_no_time_passes(cell: VirtualCell, tmp_path):
    control = RunControl()
    went_on: list[bool] = []
    # Should it not hear, the test ends all the same.
    rescue = threading.Timer(10.0, control.go_on)
    rescue.start()

    def held(context: StepContext) -> None:
        control.pause()
        request(tmp_path, "abort", "while it is held")
        context.safe_point()
        went_on.append(True)

    before = cell.clock.now()
    result = run_step(cell, tmp_path, held, control)
    rescue.cancel()
    assert (result.outcome.value, result.reason, went_on) == ("aborted", "while it is held", [])
    assert cell.clock.now() - before < 0.5


def test_work_that_was_told_to_end_has_its_grace_to_do_so(cell: VirtualCell):
    def tidy() -> None:
        try:
            cell.clock.sleep(100.0)
        finally:
            for _ in range(10):
                cell.clock.sleep(0.1)
            tidied.append(cell.clock.now() - begun)

    tidied: list[float] = []
    begun = cell.clock.now()
    call = InLine(cell.clock).do("work", tidy, lambda: "enough", 3.0)
    assert isinstance(call.error, Cancelled)
    assert tidied == [pytest.approx(1.0, abs=0.3)]


def test_time_that_another_thread_lets_pass_ends_nothing_there(cell: VirtualCell):
    waiting = InLine(cell.clock)
    seen: list[str] = []

    def cut() -> str | None:
        seen.append(threading.current_thread().name)
        return None

    def work() -> None:
        other = threading.Thread(target=cell.clock.sleep, args=(1.0,), name="other")
        other.start()
        cell.clock.sleep(1.0)
        other.join()

    call = waiting.do("work", work, cut, 1.0)
    assert call.error is None
    assert set(seen) == {threading.current_thread().name}


def test_the_stop_is_not_ended_by_what_it_is_for(cell: VirtualCell):
    stopped: list[float] = []

    def stop() -> str:
        cell.clock.sleep(3.0)
        stopped.append(cell.clock.now())
        return "enough"

    begun = cell.clock.now()
    call = InLine(cell.clock).do("work", lambda: cell.clock.sleep(100.0), stop, 1.0)
    assert isinstance(call.error, Cancelled)
    assert stopped == [pytest.approx(begun + 3.0, abs=0.1)]


def test_each_action_is_done_whatever_becomes_of_the_others(cell: VirtualCell):
    done: list[str] = []

    def fails() -> None:
        done.append("fails")
        raise ValueError("it cannot")

    def lasts() -> None:
        done.append("lasts")
        cell.clock.sleep(1000.0)

    problems = waiting_on(cell.clock).each({"a": fails, "b": lasts, "c": lambda: done.append("last")}, 5.0)
    assert done == ["fails", "lasts", "last"]
    assert problems == ["a: not confirmed, it cannot", "b: not confirmed, it took longer than 5 s"]
    assert cell.clock.now() < 10.0


def test_an_action_that_goes_on_past_its_end_confirms_nothing(cell: VirtualCell):
    def stubborn() -> None:
        with contextlib.suppress(Cancelled):
            cell.clock.sleep(10.0)

    assert waiting_on(cell.clock).each({"a": stubborn, "b": lambda: cell.clock.sleep(4.0)}, 5.0) == [
        "a: not confirmed, it took longer than 5 s"
    ]


def test_in_threads_none_waits_for_another_and_what_is_not_confirmed_in_time_is_told():
    done, go_on = [], threading.Event()

    def fails() -> None:
        raise RuntimeError("its link is lost")

    begun = time.monotonic()
    actions = {"laser off": lambda: go_on.wait(5), "rail stopped": lambda: go_on.wait(5), "vehicle": fails}
    problems = Threads(Clock()).each({**actions, "arm stopped": lambda: done.append("arm")}, 0.5)  # type: ignore[dict-item]
    took = time.monotonic() - begun
    go_on.set()
    assert problems == [
        "laser off: not confirmed within 0 s", "rail stopped: not confirmed within 0 s",
        "vehicle: not confirmed, its link is lost",
    ]  # fmt: skip
    assert done == ["arm"]
    assert 0.5 <= took < 0.95, "one time limit for all"


def test_a_clock_that_runs_by_itself_gets_threads():
    assert isinstance(waiting_on(Clock()), Threads)
