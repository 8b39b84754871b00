"""`cell commission`: how the checks stand is told without a device; what is for a simulated cell stays there."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.apps.cli.app import app
from cell.apps.commission.check import FILE, VERSION
from cell.apps.commission.sequence import CHECKS, FOLDER
from cell.config.cell_config import default_toml


@pytest.fixture(autouse=True)
def place(here: Path, monkeypatch) -> None:
    monkeypatch.setattr("cell.run.session.supervisor.Cell.open", lambda *_, **__: pytest.fail("the cell was opened"))
    (here / "cell.toml").write_text(default_toml())


def test_the_list_of_checks_connects_nothing_and_names_all_up_to_the_last_that_is_asked_for():
    rows = json.loads(CliRunner().invoke(app, ["commission", "--sim", "all", "--list", "--json"]).stdout)
    assert [(row["name"], row["standing"]) for row in rows] == [(check.name, "open") for check in CHECKS]
    shown = CliRunner().invoke(app, ["commission", "--sim", "all", "--list", "--until", "arm_axes"])
    assert "links" in shown.stdout and "arm_axes" in shown.stdout and "payload" not in shown.stdout


def test_the_list_says_what_makes_a_result_stale(tmp_path):
    done = {"version": VERSION, "results": {"links": {"rests_on": "another cell", "verdict": "good"}}, "mended": []}
    (tmp_path / FOLDER).mkdir()
    (tmp_path / FOLDER / FILE).write_text(json.dumps(done))
    assert "the cell is another now" in CliRunner().invoke(app, ["commission", "--sim", "all", "--list"]).stdout


@pytest.mark.parametrize("words", [("--truth", "true.toml"), ("--confirm", "simulated"), ("--until", "nothing")])
def test_what_is_for_a_simulated_cell_or_no_check_is_refused_before_anything_is_connected(words: list[str]):
    refused = CliRunner().invoke(app, ["commission", *words])
    assert "--sim all" in str(refused.exception) or 'no check "nothing"' in str(refused.exception)
