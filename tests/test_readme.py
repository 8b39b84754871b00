"""What the README shows is what the project does."""

from __future__ import annotations

import re
from pathlib import Path

from statemachine.diagram import mermaid

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    """The first fenced block of a language."""
    found = re.search(rf"```{language}\n(.*?)```", README, re.DOTALL)
    assert found is not None
    return found.group(1)


def test_the_diagram_is_current() -> None:
    assert block("mermaid").strip() == mermaid().strip()
