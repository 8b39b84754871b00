"""One authority for every ending: a stop from anywhere ends the run that is going on, and nothing goes on after it."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from cell.run.folder import list_runs, read_report
from statemachine.journal import request
from tests.support import Typed, until
from tests.support.wire import cells
from tests.support.wire.cells import ask, assert_safe, started, wait_for_step

pytestmark = pytest.mark.wire


serving = cells.serving("--seed", "3", "--speed", "1")
"""One that moves at the wall's speed."""


@pytest.fixture
def endpoints(serving: tuple[Path, dict[str, Any]], tmp_path: Path) -> dict[str, Any]:
    """Those of the served cell; the test's own folder has its `sim.toml`."""
    folder, endpoints = serving
    (tmp_path / "sim.toml").write_text((folder / "sim.toml").read_text(encoding="utf-8"), encoding="utf-8")
    return endpoints


def test_cell_abort_ends_a_calibration(endpoints: dict[str, Any], here: Path, typed: Typed) -> None:
    with started("calibrate", "-c", "sim.toml", folder=here) as work:
        wait_for_step(here, "calibration", work)
        code, _, said = typed("abort", "-c", "sim.toml")
        _, error = work.communicate(timeout=60)
    assert code == 0, said
    assert work.returncode == 1, error
    assert "cell abort" in error
    assert_safe(endpoints)
    assert [read_report(run)["outcome"] for run in list_runs(here / "runs")] == ["aborted"]


def test_a_jog_is_ended_by_a_request_and_stops_on_its_way(endpoints: dict[str, Any], tmp_path: Path) -> None:
    with started("jog", "arm", "j1", "+80deg", "-c", "sim.toml", folder=tmp_path) as work:
        request(wait_for_step(tmp_path, "jog", work), "abort", "enough")
        _, error = work.communicate(timeout=60)
    assert work.returncode == 1, error
    assert "enough" in error
    assert not ask(endpoints, op="truth")["truth"]["arm"]["moving"]
    (folder,) = list_runs(tmp_path / "runs")
    assert read_report(folder)["outcome"] == "aborted"


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.campaign), signal.SIGINT]
)
def test_a_signal_while_the_cell_starts_is_told_and_leaves_no_process(tmp_path: Path, number: signal.Signals) -> None:
    with started("dry-run", "--seed", "3", folder=tmp_path) as run:
        started_by_it = Path(f"/proc/{run.pid}/task/{run.pid}/children")
        assert until(started_by_it.read_text, 60.0)
        children = started_by_it.read_text().split()
        os.kill(run.pid, number)
        _, error = run.communicate(timeout=60)  # a loop that is just being compiled is finished
    assert run.returncode == 130
    assert "asked to end" in error or "interrupted from the keyboard" in error
    assert "Traceback" not in error
    # A world whose start the signal cut in two ends by itself, because its standard input has ended.
    assert until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children), 20.0)
