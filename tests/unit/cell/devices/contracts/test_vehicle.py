"""The vehicle in this process keeps the contract of its kind as those on wires do."""

from cell.devices.contracts import VehicleContract
from tests.unit.cell.devices.contracts.test_device import Direct


class TestVehicle(Direct, VehicleContract):
    NAME = "vehicle"
