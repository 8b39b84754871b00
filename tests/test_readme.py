"""What the README shows is what the project does."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from statemachine.diagram import mermaid

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    """The first fenced block of a language."""
    found = re.search(rf"```{language}\n(.*?)```", README, re.DOTALL)
    assert found is not None
    return found.group(1)


def test_the_diagram_is_current() -> None:
    assert block("mermaid").strip() == mermaid().strip()


@pytest.mark.wire
def test_the_supervisor_script_runs_as_printed(tmp_path: Path) -> None:
    script = tmp_path / "supervise.py"
    script.write_text(block("python"), encoding="utf-8")
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("placed")
    assert "mean D" in done.stdout
