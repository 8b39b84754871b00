"""What a job's run gives its starter, and who is told of its events."""

from cell.run.job_run import each_of
from statemachine.step import Event


def test_an_observer_that_fails_is_told_nothing_more_and_keeps_no_other_from_listening(caplog):
    told: list[str] = []

    def broken(event: Event) -> None:
        told.append("broken")
        raise OSError("no room")

    notify = each_of((broken, lambda event: told.append(event.kind)))
    for kind in ("note", "state"):
        notify(Event(kind, None, {}))
    assert told == ["broken", "note", "state"]
    assert [line.getMessage() for line in caplog.records] == [
        "an observer of the run failed and is told nothing more: no room"
    ]
