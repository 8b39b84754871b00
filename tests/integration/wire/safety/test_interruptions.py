"""Runs that something interrupts: scheduled faults and what the cell makes of them, and going on afterwards."""

from __future__ import annotations

import json
import signal
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from cell.procedures.sweep.stored_sweep import FILE
from cell.run.folder import list_runs, read_report, run_row
from cell.run.resumption import UnfinishedRun
from drivers.clock import Clock
from drivers.errors import ConfigError
from tests.support.wire.cells import ask, assert_safe, cell, served, started, wait_for_step

# Long runs over the wires of what the virtual clock shows in seconds.
pytestmark = [pytest.mark.wire, pytest.mark.campaign]


def dry_run(folder: Path, *faults: str, job: str = "pot") -> dict[str, Any]:
    """The report of a dry run of the job in which the faults happen."""
    options = [word for fault in faults for word in ("--inject", fault)]
    done = cell("dry-run", "--seed", "3", "--json", "--confirm", "simulated", "-j", job, *options, folder=folder)
    assert "Traceback" not in done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert report["injected"] == list(faults)
    assert done.returncode == (0 if report["outcome"] == "placed" else 1)
    return report


def vehicle_place(endpoints: dict[str, Any]) -> list[float]:
    """Where the vehicle truly stands on the floor, x and y in m; its body leans with the arm."""
    pose = ask(endpoints, op="truth")["truth"]["poses"]["world_from_vehicle"]
    return [pose[0][3], pose[1][3]]


def retries(report: dict[str, Any], step: str) -> int:
    return int(next(row["retries"] for row in report["steps"] if row["name"] == step))


def test_the_cell_recovers_from_a_protective_stop_in_the_sweep_and_a_lost_bus_on_the_way(place: Path) -> None:
    report = dry_run(place, "can.bus_off@drive_to_target:30%", "arm.protective_stop@laser_sweep:40%")
    assert report["outcome"] == "placed", report["reason"]
    assert retries(report, "drive_to_target") >= 1
    assert retries(report, "laser_sweep") >= 1
    assert report["truth"]["error_mm"]["d"]["mean"] <= 0.60


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("vehicle.emergency_stop@drive_to_target:30%", "vehicle"),
        ("arm.protective_stop@place:40%", "arm"),
        ("vehicle.motor_fault@place:40%", "vehicle"),
        ("target_camera.silent@board_photo:0%", "target_camera"),
        ("rail.late_reply@laser_sweep:0%", "rail: replies come so late that times are not known"),
    ],
)
def test_a_fault_that_a_program_may_not_clear_ends_the_run_safe_and_names_the_device(
    place: Path, fault: str, named: str
) -> None:
    report = dry_run(place, fault)
    assert report["outcome"] == "faulted"
    assert report["reason"].startswith(named)
    end = report["end_state"]
    assert not end["laser_on"]
    assert end["vehicle"]["stopped"]
    assert end["vehicle"]["braked"]
    assert not end["arm"]["moving"]
    assert not end["rail_moving"]
    assert end["part"]["held"], "whatever fails before the release, the part stays in the claw"


@pytest.mark.parametrize(
    ("moment", "number"), [("the report is made", signal.SIGTERM), ("the cell is closed", signal.SIGINT)]
)
def test_a_signal_after_the_part_was_placed_ends_the_program_as_interrupted_and_the_report_stays_true(
    place: Path, moment: str, number: signal.Signals
) -> None:
    before = set(list_runs(place / "runs"))
    with started("dry-run", "--seed", "3", folder=place) as run:
        assert run.stdout is not None
        if moment == "the report is made":
            wait_for_end(place, before)
            shown = ""
        else:
            shown = run.stdout.readline()
        run.send_signal(number)
        rest, error = run.communicate(timeout=60)
    assert run.returncode == 130, error
    assert (shown + rest).startswith("placed  ")
    assert "interrupted after the part had been placed" in error
    (folder,) = set(list_runs(place / "runs")) - before
    report = read_report(folder)
    assert report["outcome"] == "placed"
    assert report["end_state"]["vehicle"]["braked"]


def wait_for_end(folder: Path, before: set[Path]) -> None:
    """Wait until a run that was not there before has placed."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if any(run_row(run)["outcome"] == "placed" for run in set(list_runs(folder / "runs")) - before):
            return
        Clock().sleep(0.01)
    raise AssertionError("no run placed")


def test_an_arm_whose_states_all_come_late_does_not_sweep(place: Path) -> None:
    shipped = (files("cell") / "jobs" / "pot.toml").read_text()
    (place / "arm.toml").write_text(
        shipped.replace('mode = "rail"', 'mode = "arm"').replace("pot.ply", str(files("cell") / "jobs" / "pot.ply"))
    )
    report = dry_run(place, "arm.late_states@laser_sweep:0%", job="arm")
    assert report["outcome"] == "faulted"
    assert report["reason"].startswith("arm: replies come so late that times are not known")
    assert report["end_state"]["part"]["held"]


def test_a_vehicle_that_was_turned_by_hand_is_not_driven_blind(place: Path) -> None:
    with served(place, "--seed", "3") as endpoints:
        assert cell("jog", "vehicle", "+30deg", "-c", "sim.toml", folder=place).returncode == 0
        stood = vehicle_place(endpoints)
        done = cell("run", "-c", "sim.toml", "--json", folder=place)
        assert done.returncode == 1, done.stderr
        report = json.loads(done.stdout)
        assert report["outcome"] == "refused"
        assert "where the vehicle stands is not known" in report["reason"]
        assert "--at-start" in report["reason"]
        assert vehicle_place(endpoints) == pytest.approx(stood, abs=1e-4)
        assert report["end_state"]["collisions"] == []
        assert report["part"] == "held"


def test_an_aborted_run_is_resumed_without_driving_or_sweeping_again(place: Path) -> None:
    with served(place, "--seed", "3") as endpoints:
        with started("run", "-c", "sim.toml", "--at-start", "--json", folder=place) as run:
            folder = wait_for_step(place, "place", run)
            run.send_signal(signal.SIGINT)
            run.communicate(timeout=30)
        assert_safe(endpoints)
        stood = vehicle_place(endpoints)
        done = cell("resume", "-c", "sim.toml", "--json", folder=place)
        assert done.returncode == 0, done.stderr
        report = json.loads(done.stdout)
        assert report["outcome"] == "placed"
        assert report["resumed_from"] == folder.name
        assert "has not moved" in done.stderr
        assert vehicle_place(endpoints) == pytest.approx(stood, abs=1e-4)
        assert report["truth"]["error_mm"]["d"]["mean"] <= 0.60
        again = cell("resume", "-c", "sim.toml", folder=place)
        empty = cell("run", "-c", "sim.toml", "--json", folder=place)
    assert again.returncode == 2
    assert "has ended placed" in again.stderr
    assert empty.returncode == 1
    assert "holds no part" in json.loads(empty.stdout)["reason"]
    with pytest.raises(ConfigError, match="only a run that was aborted"):
        UnfinishedRun.find(place / "runs" / report["run"])
    assert (place / "runs" / report["run"] / FILE).exists()


def test_a_vehicle_that_was_pushed_meanwhile_makes_the_resumed_run_sweep_again(place: Path) -> None:
    with served(place, "--seed", "3"):
        with started("run", "-c", "sim.toml", "--at-start", "--json", folder=place) as run:
            wait_for_step(place, "place", run)
            run.send_signal(signal.SIGINT)
            run.communicate(timeout=30)
        assert cell("jog", "vehicle", "-0.003m", "-c", "sim.toml", folder=place).returncode == 0
        done = cell("resume", "-c", "sim.toml", "--json", folder=place)
    assert done.returncode == 0, done.stderr
    assert "sweeping again" in done.stderr
    assert json.loads(done.stdout)["truth"]["error_mm"]["d"]["mean"] <= 0.60
