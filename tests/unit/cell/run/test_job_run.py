"""What a job's run gives its starter, and who is told of its events."""

from __future__ import annotations

import pytest

from cell.run.job_run import RunOutcome, each_of
from lab.bench.job.whole_job import JobRecord
from statemachine.step import Event
from tests.support import report_runs
from tests.support.report_runs import Ends


def test_a_result_in_a_notebook_is_short_and_escaped(ends: Ends, placed_pot: JobRecord) -> None:
    placed = ends(report_runs.placed)
    result = RunOutcome("refused", "<script>alert('x')</script>" + 500 * "y", placed.folder, placed.report)
    html = result._repr_html_()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert len(html) < 3000
    assert "at most 0.6 mm" in html
    assert len(repr(result)) < 100
    assert str(result).startswith("refused: ")
    assert placed_pot.calibration is not None
    assert "χ²/dof" in placed_pot.calibration._repr_html_()
    assert len(repr(placed_pot.calibration)) < 100


def test_an_observer_that_fails_is_told_nothing_more_and_keeps_no_other_from_listening(
    caplog: pytest.LogCaptureFixture,
) -> None:
    told: list[str] = []

    def broken(event: Event) -> None:
        told.append("broken")
        raise OSError("no room")

    tell = each_of((broken, lambda event: told.append(event.kind)))
    for kind in ("note", "state"):
        tell(Event(kind, None, {}))
    assert told == ["broken", "note", "state"]
    assert [line.getMessage() for line in caplog.records] == [
        "an observer of the run failed and is told nothing more: no room"
    ]
