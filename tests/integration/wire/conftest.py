"""What several of the wire tests start from."""

import subprocess
import sys
from pathlib import Path

import pytest

from cell import Cell
from cell.run.folder import list_runs, read_report
from tests.project.test_readme import block
from tests.support.wire.cells import Supervised


@pytest.fixture(scope="session")
def supervised(tmp_path_factory) -> Supervised:
    """The script that the README prints, over the wires, where the cell of seed 3 was calibrated without wires."""
    folder = tmp_path_factory.mktemp("cell")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        with Cell.open(sim="all", seed=3, clock="virtual") as virtual:
            virtual.calibrate()
    (folder / "supervise.py").write_text(block("python"), encoding="utf-8")
    done = subprocess.run([sys.executable, "supervise.py"], cwd=folder, capture_output=True, text=True, timeout=900.0)
    # Here, so that it is tried again as any other test over the wires.
    assert (done.returncode, done.stdout[:6]) == (0, "placed"), done.stdout + done.stderr
    (run,) = (run for run in list_runs(folder / "runs") if read_report(run)["kind"] == "job")
    return Supervised(folder, done.stdout, read_report(run))


@pytest.fixture(scope="session")
def place(supervised: Supervised) -> Path:
    """A folder with the calibration of the simulated cell of seed 3; tests run jobs in it."""
    return supervised.folder
