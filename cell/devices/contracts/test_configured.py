"""The devices of a configured cell, put to the contracts of their kinds; the package says how it is started."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from cell.config.cell_config import CellConfig, load_config, require_real_addresses
from cell.devices.assembly import connect_one
from cell.devices.contracts import Bench
from cell.devices.contracts.arm import ArmContract
from cell.devices.contracts.device import CameraContract, ClawContract, LaserContract
from cell.devices.contracts.rail import RailContract
from cell.devices.contracts.vehicle import VehicleContract
from cell.devices.lock import CellLock
from cell.devices.simulated.process import cause_fault, clear_faults
from drivers.clock import Clock
from drivers.interfaces import Arm, Device

pytestmark = pytest.mark.skipif(
    "CELL_CONTRACTS" not in os.environ, reason="CELL_CONTRACTS names no configuration: no device is touched"
)


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


def bench_of(config: CellConfig, name: str) -> Iterator[Bench[Device]]:
    """The bench of one device; what hangs on the arm brings the arm with it."""
    clock = Clock(config.cell.time_scale)
    with ExitStack() as over:
        arm = None
        if config.make(name).on_arm:
            arm = connect_one(config, "arm", clock)
            over.callback(arm.close)
        motion = float(os.environ.get("CELL_CONTRACTS_MOTION", "0.2"))
        linked = not config.make(name).on_arm
        faults = ServedFaults(config.cell.truth, arm) if config.cell.truth else None
        bench = Bench(lambda: connect_one(config, name, clock, arm=arm), clock, motion, linked, faults)
        over.callback(bench.over)
        yield bench


class _Configured:
    NAME = ""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls, configured: CellConfig) -> Iterator[Bench[Device]]:
        """The device of this name."""
        yield from bench_of(configured, cls.NAME)


class TestRail(_Configured, RailContract):
    """The rail."""

    NAME = "rail"


class TestArm(_Configured, ArmContract):
    """The arm."""

    NAME = "arm"


class TestVehicle(_Configured, VehicleContract):
    """The vehicle."""

    NAME = "vehicle"

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls, configured: CellConfig) -> Iterator[Bench[Device]]:
        """The vehicle, where there is one that drives."""
        if not configured.vehicle.DRIVES:
            pytest.skip("the arm stands on a fixed frame: there is no vehicle")
        yield from bench_of(configured, cls.NAME)


class TestScanCamera(_Configured, CameraContract):
    """The camera on the rail."""

    NAME = "scan_camera"


class TestTargetCamera(_Configured, CameraContract):
    """The camera on the flange."""

    NAME = "target_camera"


class TestLaser(_Configured, LaserContract):
    """The laser."""

    NAME = "laser"


class TestClaw(_Configured, ClawContract):
    """The claw."""

    NAME = "claw"
