"""Cameras, laser and claw in this process, on the virtual clock, keep the contracts of their kinds."""

from types import SimpleNamespace
from typing import Any

import pytest

from cell.config.cell_config import load_config
from cell.devices.contracts import Bench, CameraContract, ClawContract, LaserContract
from cell.devices.simulated.direct import VirtualCell


class Direct:
    NAME, CONFIG = "", load_config(None)

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Bench[Any]:
        cell = VirtualCell(cls.CONFIG, seed=4, level="ideal")
        device = getattr(cell, cls.NAME, None) or getattr(cell.devices, cls.NAME).bare
        faults = SimpleNamespace(cause=cell.fault, clear=cell.clear_faults)
        return Bench(lambda: device, cell.clock, linked=False, faults=faults)


class TestScanCamera(Direct, CameraContract):
    NAME = "scan_camera"


class TestTargetCamera(Direct, CameraContract):
    NAME = "target_camera"


class TestLaser(Direct, LaserContract):
    NAME = "laser"


class TestClaw(Direct, ClawContract):
    NAME = "claw"
