"""A calibration is made for the devices that are there."""

import resource
from pathlib import Path

import pytest

from cell import Cell
from cell.config.cell_config import load_config
from cell.devices.simulated.direct import VirtualCell
from cell.run.calibration import _require_writable, serial_numbers
from drivers.errors import CellError
from tests.unit.cell.config.calibrations.test_store import DEVICES


def test_a_calibration_belongs_to_the_arm_the_rail_and_both_cameras():
    """An exchanged one of these is another cell: each is asked itself."""
    devices = VirtualCell(load_config(None), 1).devices
    assert serial_numbers(devices) == {name: getattr(devices, name).identity().serial for name in DEVICES}


def test_nothing_moves_where_a_calibration_cannot_be_stored(here: Path):
    with Cell.open(sim="all", clock="virtual") as cell:
        (here / "calibrations").touch()
        before = cell.devices.arm.state().joints
        with pytest.raises(CellError, match=r"no calibration can be stored in .*calibrations: .* `df -h` tells"):
            cell.calibrate()
        assert (cell.devices.arm.state().joints == before).all()


def test_a_disk_that_takes_an_empty_file_only_is_full(tmp_path):
    most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, most[1]))
    try:
        with pytest.raises(CellError, match="whether the disk is full"):
            _require_writable(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, most)
