"""The script that the README prints runs as printed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_readme import block


@pytest.mark.wire
def test_the_supervisor_script_runs_as_printed(place: Path, tmp_path: Path) -> None:
    shutil.copytree(place / "calibrations", tmp_path / "calibrations")
    script = tmp_path / "supervise.py"
    script.write_text(block("python"), encoding="utf-8")
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("placed")
    assert "mean D" in done.stdout
