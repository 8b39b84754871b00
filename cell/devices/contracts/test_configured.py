"""The devices of a configured cell, put to the contracts of their kinds; the package says how it is started."""

import os
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from cell.config.cell_config import CellConfig, load_config, require_real_addresses
from cell.devices.assembly import connect_one
from cell.devices.contracts import (
    ArmContract,
    Bench,
    CameraContract,
    ClawContract,
    LaserContract,
    RailContract,
    VehicleContract,
)
from cell.devices.lock import CellLock
from cell.devices.simulated.process import cause_fault, clear_faults
from drivers.clock import Clock
from drivers.interfaces import Arm, Device

pytestmark = pytest.mark.skipif(
    "CELL_CONTRACTS" not in os.environ, reason="CELL_CONTRACTS names no configuration: no device is touched"
)
SUITES = {
    "rail": RailContract, "arm": ArmContract, "vehicle": VehicleContract, "scan_camera": CameraContract,
    "target_camera": CameraContract, "laser": LaserContract, "claw": ClawContract,
}  # fmt: skip


@pytest.fixture(scope="module")
def configured() -> Iterator[CellConfig]:
    """The configuration, its devices held."""
    config = load_config(Path(os.environ["CELL_CONTRACTS"]))
    require_real_addresses(config)
    with CellLock(config):
        yield config


@dataclass(frozen=True)
class ServedFaults:
    """The faults of a served simulated cell, through its truth endpoint; `arm` is what the device hangs on, if any."""

    address: str
    arm: Arm | None

    def cause(self, name: str) -> None:
        """Cause one."""
        cause_fault(self.address, name)

    def clear(self) -> None:
        """Take them all away."""
        clear_faults(self.address)
        if self.arm is not None:
            self.arm.recover(confirmed=True)


class Configured:
    """A suite of the device `NAME`; what hangs on the arm brings the arm with it."""

    NAME = ""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls, configured: CellConfig) -> Iterator[Bench[Device]]:
        """Of the device, connected; a frame that stands has no vehicle to put to a suite."""
        name, make, clock = cls.NAME, configured.make(cls.NAME), Clock(configured.cell.time_scale)
        if name == "vehicle" and not configured.vehicle.DRIVES:
            pytest.skip("the arm stands on a fixed frame: there is no vehicle")
        with ExitStack() as over:
            arm = connect_one(configured, "arm", clock) if make.on_arm else None
            if arm is not None:
                over.callback(arm.close)
            motion = float(os.environ.get("CELL_CONTRACTS_MOTION", "0.2"))
            faults = ServedFaults(configured.cell.truth, arm) if configured.cell.truth else None
            bench = Bench(lambda: connect_one(configured, name, clock, arm=arm), clock, motion, not make.on_arm, faults)
            over.callback(bench.over)
            yield bench


for _name, _suite in SUITES.items():
    _class = f"Test{_name.title().replace('_', '')}"
    globals()[_class] = type(_class, (Configured, _suite), {"NAME": _name})
