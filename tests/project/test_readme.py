"""What the README shows is what the project does."""

from __future__ import annotations

import re
import shlex
from typing import Any

import pytest
import typer

import lab.cli
from cell.apps.cli.app import app
from cell.procedures.steps.kinds import PLACE
from statemachine.sequence import mermaid
from tests.support import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    """The first fenced block of a language."""
    found = re.search(rf"```{language}\n(.*?)```", README, re.DOTALL)
    assert found is not None
    return found.group(1)


def command_lines() -> list[str]:
    """Every `cell …` of the shell blocks, without comments and optional brackets."""
    text = "\n".join(re.findall(r"```sh\n(.*?)```", README, re.DOTALL))
    parts = re.split(r"[;\n]|&&", re.sub(r"#.*", "", text))
    return [re.sub(r"[\[\]]", "", part).strip() for part in parts if part.strip().startswith("cell ")]


def test_the_diagram_is_current() -> None:
    assert block("mermaid").strip() == mermaid(PLACE.sequence()).strip()


@pytest.mark.parametrize("line", command_lines())
def test_every_command_that_is_shown_exists_with_its_options(line: str) -> None:
    # The laboratory's commands come by its entry point, where it is installed.
    commands = typer.Typer() if line.startswith(("cell bench", "cell paper")) else app
    if commands is not app:
        lab.cli.register(commands)
    command: Any = typer.main.get_command(commands)
    for word in shlex.split(line)[1:]:
        for name in word.split("|"):
            if name.startswith("--") or re.fullmatch(r"-[a-z]", name):
                options = [option for each in command.params for option in each.opts]
                assert name.partition("=")[0] in options, f"{line}: {name}"
        if not word.startswith("-") and hasattr(command, "commands"):
            names = word.split("|")
            if any(name in command.commands for name in names):
                assert all(name in command.commands for name in names), line
                command = command.commands[names[0]]
    assert command.name != "cell", line
