"""Where compiled kernels are kept: those of the optics in their own folder, all others beside their files."""

import os
import subprocess
import sys
from pathlib import Path

from numba.core import config

from sim_backends.optics.compiled import _kept_there

SHOW = """
import sim_backends.optics.render
from sim_backends.optics.lighting import fill_background
from cell.base.compiled import load
from cell.measure.inversion.nominal import closest
load()
print(fill_background.stats.cache_path)
print(closest.stats.cache_path)"""


def test_a_simulator_in_the_process_does_not_move_what_the_cell_keeps():
    """Else each of its kernels is compiled twice: for processes with a simulated cell in them, and for others."""
    plain = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    optics, cell = subprocess.check_output([sys.executable, "-c", SHOW], env=plain, text=True).split()
    assert "kernels-" in optics
    assert Path(cell).parts[-4:] == ("cell", "measure", "inversion", "__pycache__")


def test_a_folder_that_the_user_names_holds_all(monkeypatch):
    monkeypatch.setitem(vars(config), "CACHE_DIR", "/named")
    with _kept_there():
        assert config.CACHE_DIR == "/named"
