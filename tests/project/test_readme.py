"""What the README and the pages of docs/ show is what the project does."""

import re
import shlex
from typing import Any

import pytest
import typer

import cell
import lab.cli
from cell.apps.cli.app import app
from tests.support import ROOT

PAGES = ["README.md", *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md"))]


def blocks(language: str, page: str = "README.md") -> list[str]:
    """The fenced blocks of a language, of the README or of another page; indented ones as well."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)


def block(language: str, page: str = "README.md") -> str:
    """The first fenced block of a language."""
    return blocks(language, page)[0]


def command_lines() -> list[str]:
    """Every `cell …` of the shell blocks, each once, without comments and optional brackets."""
    text = "\n".join(part for page in PAGES for part in blocks("sh", page))
    parts = re.split(r"[;\n]|&&", re.sub(r"#.*", "", text))
    return sorted({re.sub(r"[\[\]]", "", part).strip() for part in parts if part.strip().startswith("cell ")})


@pytest.mark.parametrize("page", [page for page in PAGES if page == "README.md" or page.startswith("docs/tutorials/")])
def test_a_beginner_imports_from_the_public_door_alone(page: str):
    code = "\n".join([*blocks("py", page), *blocks("python", page)])
    assert re.findall(r"^\s*(?:from|import) cell\.\w+", code, re.MULTILINE) == []
    for names in re.findall(r"^\s*from cell import (.+)$", code, re.MULTILINE):
        assert {name.strip() for name in names.split(",")} <= set(cell.__all__)


def test_the_relative_links_of_the_readme_lead_somewhere():
    links = re.findall(r"\]\((?!http)([^)#]+)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert len(links) > 20
    assert [link for link in links if not (ROOT / link).exists()] == []


@pytest.mark.parametrize("line", command_lines())
def test_every_command_that_is_shown_exists_with_its_options(line: str):
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
