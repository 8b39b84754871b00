"""The line of a job: kept beside it, shown while it holds, and told to be out of date after a change."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.apps.qualify.answer import JobAnswer
from cell.apps.qualify.identity import QualifiedCode
from cell.apps.qualify.kept import keep_line, kept_line, line_file
from cell.config.cell_config import default_toml, load_config
from cell.config.job import job_path
from tests.support import Typed
from tests.support.qualified import row

LINE = "qualified 2026-11-30, 1 world of nominal, yield 100.0 % [2.5, 100.0]"


@pytest.fixture
def own(here: Path) -> Path:
    """The job `pot` and the configuration that ship, as files of the present folder."""
    shipped = job_path("pot")
    (here / "pot.ply").write_bytes((shipped.parent / "pot.ply").read_bytes())
    (here / "pot.toml").write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
    (here / "cell.toml").write_text(default_toml(), encoding="utf-8")
    return here


def keep(job: str, config: Path | None) -> Path:
    of = QualifiedCode.of(job, load_config(config))
    told = JobAnswer.of_rows(of, "nominal", first=1, rows=[row(1)], command=lambda one: "", date="2026-11-30")
    return keep_line(told, job, config)


def test_a_line_holds_until_job_or_configuration_change(own: Path) -> None:
    assert kept_line("pot", None) is None
    assert keep("pot", Path("cell.toml")) == Path("pot.qualified.json")
    assert kept_line("pot", None) == LINE
    text = (own / "cell.toml").read_text(encoding="utf-8")
    (own / "cell.toml").write_text("# a comment\n" + text, encoding="utf-8")
    assert kept_line("pot", None) == LINE
    (own / "pot.toml").write_text((own / "pot.toml").read_text(encoding="utf-8") + "\n", encoding="utf-8")
    told = kept_line("pot", None)
    assert told == f"{LINE}: that does not hold any more, job has changed since; `cell qualify pot` tells anew"
    changed = text.replace('name = "cell-1"', 'name = "cell-2"')
    assert changed != text
    (own / "cell.toml").write_text(changed, encoding="utf-8")
    assert "job and configuration have changed" in str(kept_line("pot", None))


def test_that_of_a_job_that_ships_lies_below_the_calibrations(here: Path) -> None:
    assert line_file("tray4#2", None) == here / "calibrations" / "qualified" / "tray4-2.qualified.json"
    assert keep("pot", None) == here / "calibrations" / "qualified" / "pot.qualified.json"
    assert kept_line("pot", None) == LINE


def test_what_cannot_be_read_is_left_out(own: Path) -> None:
    file = keep("pot", Path("cell.toml"))
    file.write_text(file.read_text(encoding="utf-8").replace("100.0 %", "99.9 %"), encoding="utf-8")
    assert kept_line("pot", None) is None, "a line that was edited is none"
    assert kept_line("nothing", None) is None


def test_a_command_that_runs_the_job_shows_it(own: Path, typed: Typed) -> None:
    keep("pot", Path("cell.toml"))
    _, _, complaints = typed("dry-run", "--inject", "arm.nothing@place:1%")
    assert LINE not in complaints, "nothing is told before the command is right"
    _, _, complaints = typed("dry-run", "--clock", "virtual", "--speed", "2")
    assert LINE in complaints
