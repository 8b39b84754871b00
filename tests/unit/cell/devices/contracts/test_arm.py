"""The arm in this process keeps the contract of its kind as those on wires do."""

from cell.devices.contracts import ArmContract
from tests.unit.cell.devices.contracts.test_device import Direct


class TestArm(Direct, ArmContract):
    NAME = "arm"
