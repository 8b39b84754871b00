"""Cameras, laser and claw in this process, on the virtual clock, keep the contracts of their kinds."""

from __future__ import annotations

from typing import Any

import pytest

from cell.config.cell_config import load_config
from cell.devices.contracts import Bench, CameraContract, ClawContract, LaserContract
from cell.devices.simulated.direct import VirtualCell


class DirectFaults:
    """The faults of a cell on the virtual clock."""

    def __init__(self, cell: VirtualCell) -> None:
        self.cause, self.clear = cell.fault, cell.clear_faults


class Direct:
    NAME, CONFIG = "", load_config(None)

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Bench[Any]:
        cell = VirtualCell(cls.CONFIG, seed=4, level="ideal")
        device = getattr(cell, cls.NAME, None) or getattr(cell.devices, cls.NAME).bare
        return Bench(lambda: device, cell.clock, linked=False, faults=DirectFaults(cell))


class TestScanCamera(Direct, CameraContract):
    NAME = "scan_camera"


class TestTargetCamera(Direct, CameraContract):
    NAME = "target_camera"


class TestLaser(Direct, LaserContract):
    NAME = "laser"


class TestClaw(Direct, ClawContract):
    NAME = "claw"
