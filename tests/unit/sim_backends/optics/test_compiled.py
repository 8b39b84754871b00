"""Where compiled kernels are kept: those of the optics in their own folder, all others beside their files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SHOW = """
import sim_backends.optics.render
from sim_backends.optics.lighting import fill_background
from cell.base.compiled import load
from cell.measure.inversion.nominal import closest
load()
print(fill_background.stats.cache_path)
print(closest.stats.cache_path)"""


def folders(**environment: str) -> list[str]:
    plain = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    run = subprocess.run(
        [sys.executable, "-c", SHOW], env=plain | environment, capture_output=True, text=True, check=True
    )
    return run.stdout.split()


def test_a_simulator_in_the_process_does_not_move_what_the_cell_keeps() -> None:
    """Else each of its kernels is compiled twice: for processes with a simulated cell in them, and for others."""
    optics, cell = folders()
    assert "kernels-" in optics
    assert Path(cell).parts[-4:] == ("cell", "measure", "inversion", "__pycache__")


def test_a_folder_that_the_user_names_holds_all(tmp_path) -> None:
    assert all(folder.startswith(str(tmp_path)) for folder in folders(NUMBA_CACHE_DIR=str(tmp_path)))
