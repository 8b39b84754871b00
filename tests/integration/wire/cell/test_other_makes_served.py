"""A cell with a Modbus rail, a laser on a relay board and a Robotiq-style claw, as docs/how-to/other-makes.md has
it."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cell.config.cell_config import default_toml
from tests.support import ROOT
from tests.support.wire.cells import cell, served

pytestmark = [pytest.mark.wire, pytest.mark.campaign]

BLOCKS = re.findall(
    r"```toml\n(.*?)```", (ROOT / "docs" / "how-to" / "other-makes.md").read_text(encoding="utf-8"), re.DOTALL,
)  # fmt: skip


@pytest.fixture
def configured(tmp_path) -> Path:
    """The folder with the stock cell's `cell.toml`, but for the tables that the document prints."""
    modbus, numato, _, robotiq = BLOCKS
    laser = numato[: numato.index("[claw]")] + 'witness = "0 mm"\n'
    text = default_toml()
    text = text[: text.index("[rail]")] + modbus + text[text.index("[arm]") :]
    text = text[: text.index("[laser]")] + laser + robotiq + text[text.index("[calibration]") :]
    (tmp_path / "cell.toml").write_text(text, encoding="utf-8")
    return tmp_path


def test_the_devices_keep_the_contracts_of_their_kinds(configured: Path):
    with served(configured, "-c", "cell.toml", "--seed", "4", "--level", "ideal"):
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--pyargs",
             "cell.devices.contracts.test_configured", "-k", "TestRail or TestLaser or TestClaw"],
            cwd=configured, env={**os.environ, "CELL_CONTRACTS": "sim.toml", "CELL_CONTRACTS_MOTION": "1"},
            capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        looked = cell("diag", "-c", "sim.toml", "--json", folder=configured)
    assert done.returncode == 0, done.stdout
    assert "failed" not in done.stdout
    rows = json.loads(looked.stdout)
    assert (rows["laser"]["state"], rows["laser"]["model"]) == ("off", "Numato relay module")
    assert rows["claw"]["state"] == "holds a part"
    assert all(rows[name]["ok"] for name in ("rail", "laser", "claw"))


def test_the_whole_job_ends_placed_within_the_bound(configured: Path):
    done = cell("dry-run", "-c", "cell.toml", "--seed", "2", "--json", folder=configured, timeout=900.0)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["outcome"] == "placed"
    assert report["truth"]["error_mm"]["d"]["mean"] <= 0.60 and not report["end_state"]["laser_on"]
