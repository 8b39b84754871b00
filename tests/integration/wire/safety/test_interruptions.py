"""Runs that something interrupts: scheduled faults and what the cell makes of them, and going on afterwards."""

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from cell.procedures.sweep.stored_sweep import FILE
from cell.run.resumption import UnfinishedRun
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


def retries(report: dict[str, Any], step: str) -> int:
    return int(next(row["retries"] for row in report["steps"] if row["name"] == step))


def test_the_cell_recovers_from_a_protective_stop_in_the_sweep_and_a_lost_bus_on_the_way(place: Path):
    report = dry_run(place, "can.bus_off@drive_to_target:30%", "arm.protective_stop@laser_sweep:40%")
    assert report["outcome"] == "placed", report["reason"]
    assert retries(report, "drive_to_target") >= 1 and retries(report, "laser_sweep") >= 1
    assert report["truth"]["error_mm"]["d"]["mean"] <= 0.60


def vehicle_place(endpoints: dict[str, Any]) -> list[float]:
    """Where the vehicle truly stands on the floor, x and y in m; its body leans with the arm."""
    pose = ask(endpoints, op="truth")["truth"]["poses"]["world_from_vehicle"]
    return [pose[0][3], pose[1][3]]


def test_an_aborted_run_is_resumed_without_driving_or_sweeping_again(place: Path):
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
        assert (report["outcome"], report["resumed_from"]) == ("placed", folder.name)
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
