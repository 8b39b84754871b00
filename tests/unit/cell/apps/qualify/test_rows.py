"""Rows from reports: worst item, figure nearest its limit, columns with their units."""

from __future__ import annotations

from typing import Any

import pytest

from cell.apps.qualify.rows import column, compared, error_row, row_of, shown, used
from tests.support.qualified import COVERED, ERROR, OF


def report(outcome: str = "placed", error: float = 0.2, **more: Any) -> dict[str, Any]:
    figure = {"name": "place error, largest of 45 points", "value": error, "unit": "mm", "limit": 0.6}
    return {
        "outcome": outcome, "reason": f"it {outcome}", "code": "", "cell_s": 50.0, "faults": [],
        "steps": [
            {"name": "place", "state": "done", "duration_s": 20.0, "retries": 1, "result": {}},
            {"name": "verify", "state": "done", "duration_s": 9.5, "retries": 0, "result": {"before_mm": [0.9]}},
        ],
        "measured": [{**figure, "bound": "at most", "kept": True}],
        "tolerance": {"translation_mm": 0.6}, "place_bound_95": {"d": 0.3},
        "truth": {"error_mm": {"d": {"mean": 0.5 * error, "max": error}}, "d_p95": 0.9 * error}, **more,
    }  # fmt: skip


def test_a_row_has_what_the_report_says() -> None:
    row = row_of(OF, "nominal", 7, [report()], covered=0.9)
    assert row["key"] == OF.key("nominal", 7)
    assert (row["outcome"], row["reason"], row["corrections"], row["retries"]) == ("placed", "", 1, 1)
    assert (row["cycle_s"], row["step_place_s"], row["points_covered"]) == (50.0, 20.0, 0.9)
    assert (row[ERROR], row[f"{ERROR} at most"], row["true_error_max_mm"]) == (0.2, 0.6, 0.2)
    assert (row["stated_bound_mm"], row["tolerance_mm"]) == (0.3, 0.6)


def test_a_job_of_several_items_is_as_good_as_its_worst() -> None:
    refused = report("refused", 0.5, truth=None)
    refused["steps"][0]["state"] = "failed"
    row = row_of(OF, "nominal", 7, [report(error=0.4), refused, report(error=0.1)])
    assert (row["outcome"], row["reason"], row["step"], row["parts"]) == ("refused", "it refused", "place", 3)
    assert (row["true_error_max_mm"], row[ERROR], row["cycle_s"]) == (0.4, 0.5, 150.0)


def test_a_figure_uses_a_share_of_its_limit() -> None:
    assert used(ERROR, -0.3, 0.6, " at most") == 0.5
    assert used(COVERED, 90.0, 60.0, " at least") == 0.25, "the best is 100 %"
    assert used("points [1]", 200.0, 100.0, " at least") == 0.5


@pytest.mark.parametrize(("name", "unit"), [("place error, stated 95 % bound", "mm"), ("fit, χ²/dof", "")])
def test_a_column_tells_its_figure_and_its_unit(name: str, unit: str) -> None:
    assert shown(column(name, unit)) == (name, unit)


def test_what_differs_each_time_is_not_compared() -> None:
    row = error_row(OF, "nominal", 7, outcome="error", step="", code="KeyError", reason="KeyError: 'x'")
    timed = row | {"wall_s": 3.0, "ended_s": 1e9}
    assert compared(timed) == compared(row)
    assert compared(timed | {"cycle_s": 1.0}) != compared(row)
