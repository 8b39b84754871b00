"""What several of the wire tests start from."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.wire.cells import cell


@pytest.fixture(scope="session")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the calibration of the simulated cell of seed 3; tests run jobs in it."""
    folder = tmp_path_factory.mktemp("cell")
    done = cell("calibrate", "--sim", "all", "--seed", "3", "--json", folder=folder, timeout=900.0)
    assert done.returncode == 0, done.stderr
    return folder
