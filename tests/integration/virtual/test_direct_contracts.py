"""The devices in this process, on the virtual clock, keep the contracts of their kinds as those on wires do."""

from __future__ import annotations

from typing import Any

import pytest

from cell.config.cell_config import load_config
from cell.devices.contracts import Bench
from cell.devices.contracts.arm import ArmContract
from cell.devices.contracts.device import CameraContract, ClawContract, LaserContract
from cell.devices.contracts.rail import RailContract
from cell.devices.contracts.vehicle import VehicleContract
from cell.devices.simulated.direct import VirtualCell

CONFIG = load_config(None)


class DirectFaults:
    """The faults of a cell on the virtual clock."""

    def __init__(self, cell: VirtualCell) -> None:
        self.cause, self.clear = cell.fault, cell.clear_faults


class _Direct:
    NAME = ""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Bench[Any]:
        cell = VirtualCell(CONFIG, seed=4, level="ideal")
        device = getattr(cell, cls.NAME, None) or getattr(cell.devices, cls.NAME).bare
        return Bench(lambda: device, cell.clock, linked=False, faults=DirectFaults(cell))


class TestRail(_Direct, RailContract):
    NAME = "rail"


class TestArm(_Direct, ArmContract):
    NAME = "arm"


class TestVehicle(_Direct, VehicleContract):
    NAME = "vehicle"


class TestScanCamera(_Direct, CameraContract):
    NAME = "scan_camera"


class TestTargetCamera(_Direct, CameraContract):
    NAME = "target_camera"


class TestLaser(_Direct, LaserContract):
    NAME = "laser"


class TestClaw(_Direct, ClawContract):
    NAME = "claw"
