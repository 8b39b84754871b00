"""One authority for every ending: a stop from anywhere ends the run that is going on, and nothing goes on after it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cell.run.folder import is_going, list_runs, read_report
from drivers.clock import Clock
from statemachine.journal import request
from tests.support import Typed, until
from tests.support.wire.cells import ask, assert_safe, served, started

pytestmark = pytest.mark.wire


@pytest.fixture(scope="module")
def serving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, dict[str, Any]]]:
    """A folder with the configuration of a served cell that moves at the wall's speed, and its endpoints."""
    folder = tmp_path_factory.mktemp("served")
    with served(folder, "--seed", "3", "--speed", "1") as endpoints:
        yield folder, endpoints


@pytest.fixture
def endpoints(serving: tuple[Path, dict[str, Any]], tmp_path: Path) -> dict[str, Any]:
    """Those of the served cell; the test's own folder has its `sim.toml`."""
    folder, endpoints = serving
    (tmp_path / "sim.toml").write_text((folder / "sim.toml").read_text(encoding="utf-8"), encoding="utf-8")
    return endpoints


def test_cell_abort_ends_a_calibration(endpoints: dict[str, Any], here: Path, typed: Typed) -> None:
    with started("calibrate", "-c", "sim.toml", folder=here) as work:
        _when_it_goes_on(here)
        code, _, said = typed("abort", "-c", "sim.toml")
        _, error = work.communicate(timeout=60)
    assert code == 0, said
    assert work.returncode == 1, error
    assert "cell abort" in error
    assert_safe(endpoints)
    assert [read_report(run)["outcome"] for run in list_runs(here / "runs")] == ["aborted"]


def test_a_jog_is_ended_by_a_request_and_stops_on_its_way(endpoints: dict[str, Any], tmp_path: Path) -> None:
    with started("jog", "arm", "j1", "+80deg", "-c", "sim.toml", folder=tmp_path) as work:
        request(_when_it_goes_on(tmp_path), "abort", "enough")
        _, error = work.communicate(timeout=60)
    assert work.returncode == 1, error
    assert "enough" in error
    assert not ask(endpoints, op="truth")["truth"]["arm"]["moving"]
    (folder,) = list_runs(tmp_path / "runs")
    assert read_report(folder)["outcome"] == "aborted"


def _when_it_goes_on(folder: Path, timeout: float = 60.0) -> Path:
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        for run in list_runs(folder / "runs"):
            if is_going(run):
                return run
        Clock().sleep(0.02)
    raise AssertionError(f"nothing went on within {timeout} s")


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.campaign), signal.SIGINT]
)
def test_a_signal_while_the_cell_starts_is_told_and_leaves_no_process(tmp_path: Path, number: signal.Signals) -> None:
    with started("dry-run", "--seed", "3", folder=tmp_path) as run:
        deadline, started_by_it = time.monotonic() + 60, Path(f"/proc/{run.pid}/task/{run.pid}/children")
        while not (children := started_by_it.read_text().split()):
            assert time.monotonic() < deadline
            Clock().sleep(0.02)
        os.kill(run.pid, number)
        _, error = run.communicate(timeout=60)  # a loop that is just being compiled is finished
    assert run.returncode == 130
    assert "asked to end" in error or "interrupted from the keyboard" in error
    assert "Traceback" not in error
    # A world whose start the signal cut in two ends by itself, because its standard input has ended.
    assert until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children), 20.0)
