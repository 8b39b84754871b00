"""`cell diag` looks and touches nothing: what no device tells is "unknown", and all is afterwards as it was before."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.wire.cells import ask, cell, served

pytestmark = pytest.mark.wire

STAYS = ("laser_on", "digital_outputs", "rail_moving", "vehicle", "arm", "part")


def test_diag_tells_what_the_devices_tell_and_changes_nothing(tmp_path: Path) -> None:
    with served(tmp_path, "--seed", "3") as endpoints:
        before = ask(endpoints, op="truth")["truth"]
        done = cell("diag", "-c", "sim.toml", "--json", folder=tmp_path)
        assert done.returncode == 0, done.stderr
        rows = json.loads(done.stdout)
        after = ask(endpoints, op="truth")["truth"]
    assert "brake unknown" in rows["vehicle"]["state"]
    assert rows["rail"]["state"].startswith("not homed")
    for name in STAYS:
        assert after[name] == before[name], name
    assert after["rail"]["carriage"] == before["rail"]["carriage"]


def test_diag_takes_the_configuration_of_the_present_folder(tmp_path: Path) -> None:
    with served(tmp_path, "--seed", "3"):
        (tmp_path / "sim.toml").rename(tmp_path / "cell.toml")
        done = cell("diag", "--json", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert all(row["ok"] for row in json.loads(done.stdout).values())
