"""The verdict of a page, and the tables that tell what was used and what was found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cell.run.folder import write_json
from cell.run.report.page.facts import compared, identities, judged, verdict

TOLERANCE = {"tolerance": {"translation_mm": 0.6}}
BOUND = {"place_bound_95": {"x": 0.1, "y": 0.1, "z": 0.2, "d": 0.25}}
OUTSIDE = {"name": "first touch", "value": 2.0, "unit": "mm", "limit": 1.0, "bound": "at most", "kept": False}


@pytest.mark.parametrize(
    ("report", "words", "good"),
    [
        ({"outcome": "placed"}, "", True),
        ({"outcome": "faulted", **TOLERANCE}, "", False),
        ({"outcome": "placed", **TOLERANCE, **BOUND}, "stated: 95 % within 0.250 mm; tolerance 0.6 mm", True),
        ({"outcome": "placed", "measured": [OUTSIDE]}, "one figure outside its limit", False),
        ({"outcome": "done", "measured": [OUTSIDE, OUTSIDE]}, "2 figures outside their limits", False),
    ],
)
def test_a_verdict_is_good_only_where_every_figure_keeps_its_limit(
    report: dict[str, Any], words: str, good: bool
) -> None:
    told = verdict(report)
    assert (told.words, told.good) == (words, good)
    assert [row.kept for row in judged(report)] == [False] * len(report.get("measured", ()))


def test_what_was_not_measured_is_not_called_an_actual_value() -> None:
    rows = {row.cells[0]: row.cells for row in compared({**TOLERANCE, **BOUND, "measured": [OUTSIDE]})}
    assert rows["part's points, largest D"][1:] == ("0 mm", "not measured", "", "at most 0.6 mm", "0.250 mm")
    assert rows["part's points, largest along z"][4:] == ("", "0.200 mm")


@pytest.mark.parametrize(
    ("seconds", "age"), [(30, "30 s"), (150, "2 min"), (9000, "2 h"), (200_000, "2 days"), (None, "made 2026-01-01")]
)
def test_a_calibration_is_told_with_its_age(tmp_path: Path, seconds: float | None, age: str) -> None:
    began = 1_790_000_000.0
    write_json(tmp_path / "calibration.json", {} if seconds is None else {"made": began - seconds})
    report = {"started": "2026-09-21T14:13:20+00:00", "calibration_hash": "abc", "calibration_date": "2026-01-01"}
    told = dict(row.cells for row in identities(tmp_path, report))["calibration"]
    assert told.startswith("hash abc, made 2026-01-01") and age in told
