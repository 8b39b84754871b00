"""What is kept of a run for its replay."""

from __future__ import annotations

import json
from pathlib import Path

from cell.console.trace import FILE, Trace, traced
from cell.run.run import Run
from cell.supervisor import Cell
from statemachine.step import Event


def test_the_steps_of_a_run_are_kept_with_their_times(cell: Cell, tmp_path: Path) -> None:
    def work(run: Run[None]) -> None:
        run.folder = tmp_path
        run.tell(Event("step_started", "drive", {"attempt": 1}))
        run.progress(0.5, "half-way")
        run.tell(Event("step_done", "drive", {"duration_s": 1.0}))
        run.tell(Event("step_started", "place", {"attempt": 1}))
        run.tell(Event("step_failed", "place", {"attempt": 1, "reason": "the test"}))

    run = Run("job", work)
    traced(cell.devices, run, Trace(cell.devices, virtual=True))
    steps = json.loads((tmp_path / FILE).read_text())["steps"]
    assert [step["name"] for step in steps] == ["drive", "place"]
    assert all(0 <= step["begin"] <= step["end"] for step in steps)
