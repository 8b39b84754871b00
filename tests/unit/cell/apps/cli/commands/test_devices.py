"""`cell jog`, `recover`, `doctor`: what they ask for first, and how they end."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.apps.cli.app import app
from cell.apps.doctor import DoctorCheck
from cell.config.cell_config import default_toml


def test_a_jog_without_a_motion_and_a_recovery_by_nobody_say_what_they_lack(monkeypatch):
    refused = CliRunner().invoke(app, ["jog"])
    assert "say what to move" in str(refused.exception) and "--sim all" in str(refused.exception)
    monkeypatch.setattr("cell.run.session.supervisor.Cell.open", lambda *_, **__: pytest.fail("the cell was opened"))
    refused = CliRunner().invoke(app, ["recover", "--sim", "all"])
    assert "a person has to look at the cell first" in str(refused.exception)
    refused = CliRunner().invoke(app, ["recover", "--sim", "all", "--by", " "])
    assert "a person has to look at the cell first" in str(refused.exception)


def test_only_what_the_configured_cell_needs_ends_with_1(here: Path, monkeypatch):
    without = json.loads(CliRunner().invoke(app, ["doctor", "--json"]).stdout)
    assert {row["what"] for row in without if row["state"] == "wrong"} <= {"packages", "disk"}
    # It reads the metadata of every package that is installed.
    monkeypatch.setattr("cell.apps.doctor.shadow_check", lambda: DoctorCheck("package names", "ok", "not looked at"))
    (here / "cell.toml").write_text(default_toml())
    real = CliRunner().invoke(app, ["doctor"])
    assert real.exit_code == 1
    assert "rail, port" in real.stdout
    (here / "cell.toml").write_text("[cell]\n")
    broken = CliRunner().invoke(app, ["doctor", "--json"])
    assert broken.exit_code == 1
    assert json.loads(broken.stdout)[0]["mend"] == "cell check -c cell.toml"
