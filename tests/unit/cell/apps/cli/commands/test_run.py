"""A job that was interrupted too late keeps its outcome, and the program says so and exits 130."""

import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import typer

from cell.apps.cli.commands.run import _perform, resume
from cell.run.job_run import RunOutcome
from drivers.errors import ConfigError
from statemachine.watch import SignalInterrupt

Opened = Callable[[], AbstractContextManager[Any]]


def outcome(folder: Path, how: str, number: int | None = None) -> RunOutcome:
    """How a job ended, after which the signal `number` came."""
    made = RunOutcome(how, "all steps done", folder, {"outcome": how, "reason": "all steps done"})
    made.control.over = True
    if number is not None:
        made.control.abort("asked to end", number)
    return made


@contextmanager
def interrupted_as_it_is_closed() -> Iterator[None]:
    yield None
    raise SignalInterrupt(signal.SIGINT)


@pytest.mark.parametrize(
    ("how", "number", "opened", "code", "said"),
    [
        ("placed", None, nullcontext, 0, ""),
        ("faulted", None, nullcontext, 1, ""),
        ("placed", signal.SIGTERM, nullcontext, 130, "interrupted after the part had been placed"),
        ("placed", None, interrupted_as_it_is_closed, 130, "interrupted after the part had been placed"),
        ("faulted", None, interrupted_as_it_is_closed, 130, "interrupted after the run had ended faulted"),
        ("aborted", signal.SIGTERM, nullcontext, 130, ""),
    ],
)
def test_the_outcome_stays_true_and_the_exit_code_tells_of_the_signal(
    tmp_path, how: str, number: int | None, opened: Opened, code: int, said: str,
    capsys,
):  # fmt: skip
    with pytest.raises(typer.Exit) as ended:
        _perform(opened, lambda cell, display: outcome(tmp_path, how, number), False, False)
    shown = capsys.readouterr()
    assert ended.value.exit_code == code
    assert shown.out.startswith(f"{how}  all steps done")
    assert shown.err.strip() == said


def test_an_interrupt_before_there_is_an_outcome_goes_on_to_the_top():
    def work(cell: object, display: object) -> RunOutcome:
        raise SignalInterrupt(signal.SIGTERM)

    with pytest.raises(SignalInterrupt):
        _perform(nullcontext, work, False, False)


def test_a_dry_run_is_resumed_in_its_own_world(tmp_path, monkeypatch):
    """Also in world 0."""
    before = SimpleNamespace(info={"simulated": True, "seed": 0, "clock": "virtual"}, job="pot", folder=tmp_path)
    opened = Mock(side_effect=ConfigError("seen enough"))
    monkeypatch.setattr("cell.run.folder.find_run", lambda *_: tmp_path)
    monkeypatch.setattr("cell.run.resumption.UnfinishedRun.find", lambda folder: before)
    monkeypatch.setattr("cell.run.session.supervisor.Cell.open", opened)
    with pytest.raises(ConfigError, match="seen enough"):
        resume()
    assert opened.call_args.kwargs["seed"] == 0
