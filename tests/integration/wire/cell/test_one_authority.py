"""One authority for every ending: a stop from anywhere ends the run that is going on, and nothing goes on after it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from cell import Cell, RunOutcome
from cell.devices.simulated.process import ask_truth
from cell.run.events import ConfirmNeeded, FaultMet, Held, RunEvent, StepProgress, StepStarted
from cell.run.folder import is_going, list_runs, read_report
from cell.run.runs import Run
from drivers.clock import Clock
from drivers.errors import InterlockError
from statemachine.journal import request
from tests.support.wire.cells import ask, assert_safe, cell, served, started

pytestmark = pytest.mark.wire


@contextmanager
def opened(place: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cell]:
    """The simulated cell of seed 3, calibrated."""
    monkeypatch.chdir(place)
    with Cell.open(sim="all", seed=3) as made:
        yield made


def until(run: Run[RunOutcome], wanted: Callable[[RunEvent], bool], timeout: float = 120.0) -> RunEvent:
    """Listen until an event is the wanted one."""
    events = run.events()
    deadline = time.monotonic() + timeout
    for event in events:
        if wanted(event):
            return event
        assert time.monotonic() < deadline
    raise AssertionError("the run ended before that")


def begins(step: str) -> Callable[[RunEvent], bool]:
    return lambda event: isinstance(event, StepStarted) and event.step == step


def joints(made: Cell) -> list[float]:
    """Where the arm truly stands."""
    pose: list[list[float]] = ask_truth(made.config.cell.truth)["poses"]["base_from_flange"]
    return [value for row in pose for value in row]


@pytest.mark.campaign
def test_stop_from_another_thread_while_it_reconstructs_ends_the_run_and_nothing_is_placed(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(place, monkeypatch) as made:
        run = made.start("pot")
        until(run, begins("reconstruct"))
        made.stop()
        before = joints(made)
        result = run.result(60.0)
        assert result.outcome == "aborted"
        assert "Cell.stop()" in result.reason
        assert [step["state"] for step in result.report["steps"]][-1] == "open"
        truth = ask_truth(made.config.cell.truth)
        assert truth["part"]["held"]
        assert joints(made) == pytest.approx(before, abs=1e-6)


@pytest.mark.campaign
def test_a_protective_stop_waits_for_a_person_a_pause_holds_and_the_part_is_placed(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(place, monkeypatch) as made:
        run = made.start("pot", inject=["arm.protective_stop@laser_sweep:40%"])
        with pytest.raises(InterlockError, match="a job is going on"):
            made.home()
        run.pause()
        held = until(run, lambda event: isinstance(event, Held))
        Clock().sleep(0.5)
        before = joints(made)
        Clock().sleep(1.0)
        assert joints(made) == pytest.approx(before, abs=1e-4), f"held at {held}"
        run.go_on()
        asked = until(run, lambda event: isinstance(event, ConfirmNeeded))
        assert isinstance(asked, ConfirmNeeded)
        assert "protective stop" in asked.reason
        before = joints(made)
        Clock().sleep(1.0)
        assert ask_truth(made.config.cell.truth)["arm"]["safety"] == "protective_stop"
        assert joints(made) == pytest.approx(before, abs=1e-4)
        assert cell("confirm", "--question", str(asked.number), "--by", "Ann", folder=place).returncode == 0
        result = run.result(120.0)
        assert result.outcome == "placed", result.reason
        (fault,) = [event for event in run.events() if isinstance(event, FaultMet)]
        assert (fault.code, fault.remedy) == ("arm.protective_stop", "confirmed by Ann, recovered")


@pytest.mark.campaign
def test_an_abort_while_a_person_is_waited_for_ends_the_run_and_the_arm_stays_locked(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(place, monkeypatch) as made:
        run = made.start("pot", inject=["arm.protective_stop@drive_to_target:0%"])
        until(run, lambda event: isinstance(event, ConfirmNeeded))
        run.abort("enough")
        assert run.result(60.0).outcome in ("aborted", "faulted")
        assert ask_truth(made.config.cell.truth)["arm"]["safety"] == "protective_stop"


@pytest.mark.campaign
def test_closing_the_cell_ends_the_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(place, monkeypatch) as made:
        run = made.start("pot")
        until(run, begins("drive_to_target"))
        made.close()
        assert run.done
        result = run.result()
        assert result.outcome in ("aborted", "faulted")
        assert "closed" in result.reason
        with pytest.raises(InterlockError, match="was closed"):
            made.start("pot")


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


def test_cell_abort_ends_a_calibration(
    endpoints: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    typed: Callable[..., tuple[int, str, str]],
) -> None:
    monkeypatch.chdir(tmp_path)
    with started("calibrate", "-c", "sim.toml", folder=tmp_path) as work:
        _when_it_goes_on(tmp_path)
        code, _, said = typed("abort", "-c", "sim.toml")
        _, error = work.communicate(timeout=60)
    assert code == 0, said
    assert work.returncode == 1, error
    assert "cell abort" in error
    assert_safe(endpoints)
    assert [read_report(run)["outcome"] for run in list_runs(tmp_path / "runs")] == ["aborted"]


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
        deadline = time.monotonic() + 60
        while not (children := _children(run.pid)):
            assert time.monotonic() < deadline
            Clock().sleep(0.02)
        os.kill(run.pid, number)
        _, error = run.communicate(timeout=60)  # a loop that is just being compiled is finished
    assert run.returncode == 130
    assert "asked to end" in error or "interrupted from the keyboard" in error
    assert "Traceback" not in error
    # A world whose start the signal cut in two ends by itself, because its standard input has ended.
    deadline = time.monotonic() + 20
    while any(Path(f"/proc/{pid}").exists() for pid in children):
        assert time.monotonic() < deadline
        Clock().sleep(0.05)


def _children(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


@pytest.mark.campaign
def test_progress_is_told_as_typed_events(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(place, monkeypatch) as made:
        run = made.start("pot")
        event = until(run, lambda event: isinstance(event, StepProgress))
        run.abort("seen enough")
        assert run.result(60.0).outcome == "aborted"
    assert event.step == "drive_to_target"
    assert abs(event.at - time.time()) < 300
