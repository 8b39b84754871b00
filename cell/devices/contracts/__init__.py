"""Contract suites, one per kind of device: what the cell relies on, as tests that any make can be put to.

A make's own tests derive from a suite and say how its device is connected:

    from cell.devices.contracts import Bench, RailContract

    class TestAcmeRail(RailContract):
        @pytest.fixture(scope="class")
        @classmethod
        def bench(cls) -> Iterator[Bench[Rail]]:
            clock = Clock()
            made = Bench(lambda: AcmeRail("rail", "/dev/acme0", clock=clock), clock, motion=0.2)
            yield made
            made.over()

The devices of a configured cell, simulated or real, are put to them all by

    CELL_CONTRACTS=cell.toml CELL_CONTRACTS_MOTION=0.2 pytest --pyargs cell.devices.contracts.test_configured

They move: by `motion` times what a suite would do by itself, and as fast.

A simulated device is also given faults, where its bench says how (`Faults`); with a real one those tests are skipped.
"""

from cell.devices.contracts.arm import ArmContract
from cell.devices.contracts.device import Bench, CameraContract, ClawContract, DeviceContract, Faults, LaserContract
from cell.devices.contracts.rail import RailContract
from cell.devices.contracts.vehicle import VehicleContract

__all__ = [
    "ArmContract", "Bench", "CameraContract", "ClawContract", "DeviceContract", "Faults", "LaserContract",
    "RailContract", "VehicleContract",
]  # fmt: skip
