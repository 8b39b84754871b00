"""The cell on the virtual clock without deviations, whose devices are looked at one by one."""

from cell.config.cell_config import load_config
from cell.devices.simulated.direct import VirtualCell

CONFIG = load_config(None)


def ideal_cell() -> VirtualCell:
    """Its rail is not homed."""
    return VirtualCell(CONFIG, seed=4, level="ideal")
