"""`cell confirm` answers one question: the one that was named, or the one that it has just shown."""

import io
import os
from pathlib import Path

import pytest

from cell.apps.cli.progress import ProgressDisplay
from cell.run.folder import new_run
from statemachine.journal import Journal, RunRequest
from statemachine.step import Event
from tests.support import Typed

CONFIRM = ("confirm", "--by", "Bob")


@pytest.fixture
def waiting(here: Path) -> Journal:
    """The journal of a run that goes on in the present folder and waits for a word on its second question."""
    folder = new_run(here / "runs")
    journal = Journal(folder, folder.name, {"kind": "job", "pid": os.getpid()})
    journal.event("confirm_needed", "laser_sweep", {"reason": "stopped in the sweep", "code": "x", "number": 1})
    journal.event("confirmed", "laser_sweep", {"by": "Ann", "reason": "stopped in the sweep"})
    journal.event("confirm_needed", "place", {"reason": "stopped while placing", "code": "x", "number": 2})
    return journal


class Terminal(io.StringIO):
    """What a person types."""

    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def nobody_at_a_terminal(monkeypatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())


def test_a_word_for_an_earlier_question_is_refused_and_the_present_one_is_shown(waiting: Journal, typed: Typed):
    code, _, said = typed(*CONFIRM, "--question", "1")
    assert code == 2
    assert "does not wait for question 1 but for question 2: stopped while placing" in said
    assert waiting.take_requests() == []
    assert typed(*CONFIRM, "--question", "2")[0] == 0
    assert waiting.take_requests() == [RunRequest("confirm", "Bob", 2)]


def test_without_a_number_the_question_that_waits_now_is_shown_and_that_one_is_answered(waiting: Journal, typed: Typed):
    code, out, _ = typed(*CONFIRM)
    assert (code, "question 2: stopped while placing" in out) == (0, True)
    assert waiting.take_requests() == [RunRequest("confirm", "Bob", 2)]


@pytest.mark.parametrize(("answer", "code"), [("n\n", 1), ("y\n", 0)])
def test_a_person_at_a_terminal_is_asked_whether_it_is_the_one_that_was_meant(
    waiting: Journal, monkeypatch, typed: Typed, answer: str, code: int
):
    monkeypatch.setattr("sys.stdin", Terminal(answer))
    assert typed(*CONFIRM)[0] == code
    assert len(waiting.take_requests()) == (1 if code == 0 else 0)


def test_who_watches_a_run_sees_the_number_and_what_to_type(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    display = ProgressDisplay()
    display(Event("confirm_needed", "place", {"reason": "the arm has stopped", "code": "x", "number": 2}))
    said = capsys.readouterr().err
    assert "question 2: the arm has stopped" in said and "cell confirm --question 2" in said


@pytest.mark.parametrize(
    ("command", "file"),
    [
        (("report", "--html"), "own.toml"), (("export",), "runs/cloud.ply"), (("record", "export"), "own.toml"),
        (("report", "--html"), "runs/x.html"),
    ],
)  # fmt: skip
def test_only_what_the_command_wrote_before_is_overwritten(
    waiting: Journal, here: Path, typed: Typed, command: tuple[str, ...], file: str
):
    (here / "runs" / "report.json").touch()
    (here / file).write_text("mine")
    code, _, err = typed(*command, "--out", file)
    assert (code, (here / file).read_text()) == (2, "mine") and "is there already, and not of this command" in err
