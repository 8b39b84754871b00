"""The rail in this process keeps the contract of its kind as those on wires do."""

from cell.devices.contracts import RailContract
from tests.unit.cell.devices.contracts.test_device import Direct


class TestRail(Direct, RailContract):
    NAME = "rail"
