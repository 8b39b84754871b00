"""Kept schedules of faults and people's acts on whole virtual jobs: none breaks a rule, and each ends as it is told to.

`kept.jsonl` has a line for each schedule that once broke a rule, or stands for a kind that matters: `ends` are the
outcomes of its runs, and `why` says what it is about. `cell bench schedules` finds more.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from lab.bench.schedules.day import perform
from lab.bench.schedules.schedule import Schedule
from lab.bench.schedules.search import campaign
from tests.support.described_cells import quick_job

KEPT = [json.loads(line) for line in (Path(__file__).parent / "kept.jsonl").read_text(encoding="utf-8").splitlines()]


def check(kept: dict[str, Any], calibrations: Path) -> None:
    """Its job swept twice as fast as shipped; where no part is drawn, in a quarter of the lines."""
    name, _, item = kept["schedule"]["job"].partition("#")
    job = f"{quick_job(name, calibrations.parent, 15.0 if name == 'pot' else 30.0)}{item and '#'}{item}"
    record = perform(Schedule.from_json(json.dumps(kept["schedule"] | {"job": job})), calibrations)
    assert [str(violation) for violation in record.violations] == []
    assert [outcome for outcome, _ in record.ends] == kept["ends"], record.ends


@pytest.mark.parametrize(
    "kept", [pytest.param(k, id=k["why"], marks=[pytest.mark.campaign] if k.get("long") else []) for k in KEPT]
)
def test_a_kept_schedule_breaks_no_rule(kept: dict[str, Any], calibrated_folder: Path):
    check(kept, calibrated_folder / "calibrations")


@pytest.mark.campaign
def test_drawn_schedules_break_no_rule(tmp_path):
    found = campaign(["pot", "load"], ["nominal"], 40, 1000, tmp_path, workers=2, told=lambda *_: None)
    assert (found["violations"], found["schedules"]) == ([], 40)
