"""Rows of a run's progress: one line each at 80 columns, their bars in one place, ended ones told from others."""

import io
import os
import subprocess
import sys

import pytest
from rich.console import Console

from cell.apps.cli.progress import ProgressDisplay, answer_here, kept_loops
from statemachine.control import RunControl
from statemachine.step import Event
from tests.support import until

LONG = "arm: it stopped [C153] because points came 15 ms late: this computer is too busy"


def rows(capsys: pytest.CaptureFixture[str], display: ProgressDisplay, *events: Event) -> dict[str, str]:
    with display:
        for event in events:
            display(event)
    return {line[2:].split()[0]: line for line in capsys.readouterr().err.splitlines() if line.strip()}


def test_at_80_columns_bars_keep_their_place_and_ended_rows_look_ended(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    shown = rows(
        capsys,
        ProgressDisplay(),
        Event("progress", "calibrate", {"fraction": 1.0, "text": "stored"}),
        Event("step_started", "drive_to_target", {}),
        Event("progress", "drive_to_target", {"fraction": 0.99, "text": LONG}),
        Event("step_done", "drive_to_target", {}),
        Event("progress", "laser_sweep", {"fraction": 0.42, "text": LONG}),
        Event("step_failed", "place", {"reason": LONG}),
    )
    assert all(len(line) <= 80 for line in shown.values())
    assert {line.index("━") for line in shown.values() if "━" in line} == {19}
    assert [(name, line[0], line[40:44]) for name, line in shown.items()] == [
        ("calibrate", "✓", "done"),
        ("drive_to_target", "✓", "done"),
        ("laser_sweep", " ", " 42%"),
        ("place", "✗", "fail"),
    ]
    assert shown["drive_to_target"].split()[-1].startswith("0:00:")
    assert "[C153]" in shown["laser_sweep"]


def test_a_first_run_shows_that_it_compiles_and_how_long_that_takes(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("cell.apps.cli.progress.LOOK_S", 0.01)
    told: list[str] = []
    monkeypatch.setattr(ProgressDisplay, "_show", lambda self, step, fraction, text: told.append(f"{step} {text}"))
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    old = tmp_path / f"old.{version}.nbi"
    old.touch()
    os.utime(old, (1.0, 1.0))
    with ProgressDisplay(compiles=True):
        for name in ("one", "two"):
            (tmp_path / f"{name}.{version}.nbi").touch()
        assert until(lambda: told, 20.0)
    assert told[0].startswith("compile once, about ")
    assert told[-1] == "compile 2 loops, kept"
    assert "compiling, once" in capsys.readouterr().err
    assert len(kept_loops()) == 3


def test_a_dry_run_says_something_before_it_loads_anything_heavy():
    code = """
import sys, typer
def said(text, err=False):
    print(text, err, *sorted({"numpy", "pinocchio", "cv2", "numba"} & set(sys.modules)))
    raise SystemExit
typer.echo = said
sys.argv = ["cell", "dry-run"]
from cell.apps.cli import main
main()"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[0] == "dry run of pot in the simulated world 1: loading True"


@pytest.mark.parametrize(("typed", "by_whom", "ended"), [(b"go\nready\n", True, None), (b"end\n", False, "terminal")])
def test_a_question_is_answered_at_the_terminal_by_what_is_typed_after_it(
    monkeypatch, typed: bytes, by_whom: bool, ended: str | None
):
    person, program = os.openpty()

    class Screen(io.StringIO):
        def write(self, text: str) -> int:
            return os.write(person, typed) if "ready" in text else 0

    os.write(person, b"end\n" if by_whom else b"ready\n")  # before the question
    control = RunControl()
    control.ask("Is the part in the claw?")
    with os.fdopen(program) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        answer_here(control, Console(file=Screen()))
    os.close(person)
    assert (control.answer() is not None, control.token.reason) == (by_whom, ended and f"ended at the {ended}")
