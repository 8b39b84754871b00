"""The rail, the arm and the vehicle in this process keep the contracts of their kinds as those on wires do."""

from __future__ import annotations

from cell.devices.contracts import ArmContract, RailContract, VehicleContract
from tests.unit.cell.devices.contracts.test_device import Direct


class TestRail(Direct, RailContract):
    NAME = "rail"


class TestArm(Direct, ArmContract):
    NAME = "arm"


class TestVehicle(Direct, VehicleContract):
    NAME = "vehicle"
