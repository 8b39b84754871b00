"""Where a package has no wheel the cell says so by name, with the remedy, and does what it can without it."""

import subprocess
import sys
from functools import partial
from typing import Any

import pytest
from typer.testing import CliRunner

from cell import Cell, NotConnectedError
from cell.apps.cli.app import app
from cell.apps.cli.commands import run
from cell.apps.doctor import asked_for
from drivers.arm.link import ArmLink
from drivers.packages import lacking

NEVER = 'ur-rtde>=1.6.3,<1.7; python_version < "3"'


@pytest.fixture
def without_wheel(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    monkeypatch.setattr("importlib.metadata.requires", lambda name: [NEVER])


def test_a_package_without_a_wheel_here_is_named_with_the_remedy(without_wheel: None, monkeypatch):
    words = lacking("rtde_control", "ur-rtde")
    assert f"ur-rtde has no wheel for Python {sys.version.split()[0]}" in words
    assert "Python 3.12 on Linux x86-64" in words
    assert lacking("numpy", "numpy") == ""
    monkeypatch.setattr("importlib.metadata.requires", lambda name: ["ur-rtde>=1.6.3,<1.7"])
    assert "pip install 'ur-rtde<1.7,>=1.6.3'" in lacking("rtde_control", "ur-rtde")


@pytest.mark.parametrize(
    ("options", "clock", "said"),
    [((), "virtual", True), (("--clock", "wall"), "wall", False), (("--speed", "2"), "wall", False)],
)
def test_a_dry_run_without_the_arms_package_takes_the_virtual_clock_and_says_so(
    without_wheel: None, monkeypatch, options: tuple[str, ...], clock: str, said: bool
):
    opened: list[partial[Any]] = []
    monkeypatch.setattr(run, "_perform", lambda cell, *others: opened.append(cell))
    done = CliRunner().invoke(app, ["dry-run", *options], catch_exceptions=False)
    assert opened[0].keywords["clock"] == clock
    assert ("virtual clock" in done.stderr and "ur-rtde has no wheel" in done.stderr) is said


def test_over_the_wires_it_is_refused_before_anything_is_started(without_wheel: None, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", lambda *given, **options: pytest.fail(f"started {given}"))
    for connect in (
        lambda: Cell.open(sim="all"),
        lambda: ArmLink("arm", None, 1.0, print, print, print),  # type: ignore[arg-type]
    ):
        with pytest.raises(NotConnectedError, match="arm: ur-rtde has no wheel"):
            connect()


def test_the_doctor_asks_for_nothing_that_has_no_wheel_here(monkeypatch):
    monkeypatch.setattr("cell.apps.doctor.tomllib.loads", lambda text: {"project": {"dependencies": [NEVER]}})
    assert asked_for(()) == {"": []}
