"""What `cell watch` shows of devices and runs says what they say."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.apps.cli.app import app
from cell.apps.watch import arm_lines, rail_lines, run_lines, shared, vehicle_lines
from cell.config.cell_config import CellConfig, load_config
from drivers.interfaces import ArmSafety, ArmState, RailState, VehicleState
from statemachine.journal import Journal


@pytest.fixture(scope="module")
def config() -> CellConfig:
    return load_config(None)


def test_positions_fit_80_columns_and_mark_what_is_near_its_limit() -> None:
    joints = np.radians([359.0, -90.0, 0.0, 10.0, 20.0, -357.0])
    flange = np.array([-0.7555, -1.2345, 0.9999, -3.1, 3.1, 0.01])
    state = ArmState(0.0, joints, joints, flange, flange, ArmSafety.NORMAL, True, 255, 3)
    limits = [math.radians(-360)] * 6, [math.radians(360)] * 6
    lines = arm_lines(state, limits)
    assert max(map(len, lines)) <= 80
    assert "safety normal, moves" in lines[0]
    assert "x -755.5  y -1234.5  z 999.9 mm" in lines[1]
    assert [word.endswith("!") for word in lines[3].split()[1:]] == [True, False, False, False, False, True]
    rail = rail_lines(RailState(0.0, 0.0123, 0.0, False, True, True, False), (0.0, 0.1))
    assert rail[0] == "rail     NOT HOMED, moves at 12.300 mm, travel 0 to 100 mm"
    assert rail[1].endswith("left pressed, right free")
    vehicle = VehicleState(0.0, 0.0, 0.0, 0.0, 0.1, 0.0, True, None, True, 0, None, ("its motor 2 is hot",))
    lines = vehicle_lines(vehicle)
    assert "EMERGENCY STOP, 100 mm/s" in lines[0]
    assert lines[1].strip() == "its motor 2 is hot"
    assert arm_lines(None, limits, "why") == ["arm      why"]


def test_only_what_serves_several_clients_is_watched_beside_another_user(config: CellConfig) -> None:
    def with_bus(interface: str) -> CellConfig:
        return config.model_copy(update={"vehicle": config.vehicle.model_copy(update={"interface": interface})})

    assert [shared(with_bus("socketcan"), name) for name in ("arm", "rail", "vehicle")] == [True, False, True]
    assert not shared(with_bus("slcan"), "vehicle")


def test_what_goes_on_is_told_by_its_journal(tmp_path: Path) -> None:
    assert "nothing goes on" in run_lines(tmp_path)[0]
    folder = tmp_path / "20260101T000000-0001"
    folder.mkdir()
    journal = Journal(folder, folder.name, {"kind": "job", "job": "pot", "pid": os.getpid()})
    journal.step_ended(journal.step_started("drive_to_target", 1), 1.0, {})
    journal.step_started("board_photo", 2)
    journal.event("confirm_needed", None, {"number": 3, "reason": "look at the arm"})
    (folder / "run.log").write_text("one\ntwo\nthree\nfour\n")
    told = run_lines(tmp_path)
    assert told[0].startswith("run      20260101T000000-0001, job pot, for ")
    assert "board_photo, attempt 2: running" in told[1]
    assert "question 3: look at the arm" in told[2]
    assert [line.strip() for line in told[3:]] == ["two", "three", "four"]
    journal.run_ended("placed", "")
    journal.close()
    assert "nothing goes on" in run_lines(tmp_path)[0]


def test_without_a_cell_or_a_motion_the_commands_say_what_they_lack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    begun = time.monotonic()
    told = CliRunner().invoke(app, ["watch", "--once"])
    assert told.exit_code == 0
    assert told.stdout.count("there is no cell.toml here") == 3
    assert time.monotonic() - begun < 20
    refused = CliRunner().invoke(app, ["jog"])
    assert "say what to move" in str(refused.exception)
    assert "--sim all" in str(refused.exception)
