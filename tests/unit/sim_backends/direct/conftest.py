"""Cells on the virtual clock without deviations whose devices the tests of this folder look at."""

import pytest

from cell.config.cell_config import load_config
from cell.devices.simulated.direct import VirtualCell


@pytest.fixture
def fresh() -> VirtualCell:
    return VirtualCell(load_config(None), seed=4, level="ideal")


@pytest.fixture(scope="module")
def cell() -> VirtualCell:
    """With its rail homed."""
    made = VirtualCell(load_config(None), seed=4, level="ideal")
    made.rail.home().wait(60.0)
    return made
