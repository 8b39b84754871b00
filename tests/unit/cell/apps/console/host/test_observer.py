"""What is shown of a run that has ended."""

import json
from typing import Any

import pytest

from cell.apps.console.host.observer import _figure
from cell.apps.console.view.run_view import RunView
from cell.run.runs import Run
from statemachine.step import Event

STEPS = ("board_photo", "laser_sweep", "reconstruct")


@pytest.mark.parametrize(
    ("report", "figure"),
    [
        ({"truth": {"error_mm": {"d": {"mean": 0.021}}}, "place_bound_95": {"d": 0.3}}, {"mm": 0.021, "kind": "true"}),
        ({"place_bound_95": {"d": 0.3}}, {"mm": 0.3, "kind": "stated"}),
        ({"place_bound_95": None}, None),
    ],
)
def test_a_placed_job_ends_with_its_figure(tmp_path, report: dict[str, Any], figure: object):
    """The true error where a simulated world tells it, else the bound that was stated, said as such."""

    def work(run: Run[Any]) -> None:
        run.folder = tmp_path
        run.notify(Event("run_ended", None, {"outcome": "placed", "reason": "all steps done"}))
        (tmp_path / "report.json").write_text(json.dumps({"outcome": "placed", **report}))

    run: Run[Any] = Run("job", work)
    view = RunView(run, STEPS, "pot", {})
    run.ended(5)
    view.news()
    assert _figure(view) == figure
