"""A run's events: typed, in order, and nobody who listens can hold the run up."""

import threading
import time

from cell.run.events import MOST_WAITING, Detached, RunEnded, StepProgress, StepStarted, Subscription
from cell.run.runs import Run
from statemachine.step import Event


def progress(step: str, fraction: float) -> Event:
    return Event("progress", step, {"fraction": fraction, "text": ""})


def test_the_newest_progress_wins_and_nothing_else_is_lost():
    events = Subscription()
    events.put(Event("step_started", "laser_sweep", {"attempt": 1}))
    for count in range(5000):
        events.put(progress("laser_sweep", count / 5000))
    events.put(Event("run_ended", None, {"outcome": "placed", "reason": "all steps done"}))
    events.close()
    got = list(events)
    assert [type(event) for event in got] == [StepStarted, StepProgress, RunEnded]
    assert isinstance(got[1], StepProgress)
    assert got[1].fraction == 4999 / 5000


def test_a_subscriber_that_never_reads_holds_a_bounded_number_of_events():
    events = Subscription()
    for count in range(3 * MOST_WAITING):
        events.put(Event("note", "place", {"count": count}))
    events.close()
    assert len(list(events)) == MOST_WAITING


def test_a_listener_that_comes_late_hears_what_was_and_a_run_that_has_ended_ends_it():
    def work(run: Run[int]) -> int:
        run.notify(Event("step_started", "place", {"attempt": 1}))
        run.notify(Event("run_ended", None, {"outcome": "placed", "reason": ""}))
        return 7

    run = Run("job", work)
    assert run.result(5.0) == 7
    assert [type(event) for event in run.events()] == [StepStarted, RunEnded]


def test_an_observer_that_sleeps_does_not_slow_the_run():
    heard: list[Event] = []
    go_on = threading.Event()

    def observer(event: Event) -> None:
        go_on.wait(10)
        heard.append(event)

    told = Detached(observer)
    begun = time.monotonic()
    for count in range(200):
        told(progress("place", count / 200))
    assert time.monotonic() - begun < 1.0
    go_on.set()
    told.close(10.0)
    assert heard[-1].data["fraction"] == 199 / 200


def test_an_observer_that_fails_is_named_and_told_nothing_more():
    def observer(event: Event) -> None:
        raise OSError("the terminal is gone")

    told = Detached(observer)
    told(progress("place", 0.5))
    told.close(5.0)
    assert told.failure == "OSError: the terminal is gone"


def test_every_event_has_its_time():
    before = time.time()
    events = Subscription()
    events.put(progress("place", 0.5))
    events.close()
    (event,) = events
    assert before <= event.at <= time.time()
