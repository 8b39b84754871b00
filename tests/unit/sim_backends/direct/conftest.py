"""The cell on the virtual clock whose devices the tests of this folder look at."""

import pytest

from cell.devices.simulated.direct import VirtualCell
from tests.support.simulator.virtual_devices import ideal_cell


@pytest.fixture(scope="module")
def cell() -> VirtualCell:
    """With its rail homed."""
    made = ideal_cell()
    made.rail.home().wait(60.0)
    return made
