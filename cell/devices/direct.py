"""A simulated cell in this process, on a virtual clock: the world's models behind the drivers' interfaces, no wires.

Puts together what `sim_backends.direct` leaves open: the configuration's values, and the product's own logic that is to
be proven there as well. Everything above the devices' interfaces is the product, unchanged.
"""

from __future__ import annotations

import numpy as np

from cell.config import CellConfig
from cell.device_config import MOST_PAYLOAD, of_make
from cell.devices.assembly import behind_gate, connect_one, safe_off_outputs
from cell.devices.built_in import TmclRailConfig
from cell.devices.described import Described
from cell.devices.devices import Devices
from cell.motion.arm_models import MODELS
from drivers.arm.faults import fault
from drivers.arm.limits import ArmLimits
from drivers.clock_map import ClockMap, Latch
from drivers.errors import ConfigError
from drivers.rail.timing import EvenMotion
from drivers.vehicle.faults import system_trouble, vehicle_error
from drivers.vehicle.odometry import PlanarOdometry
from sim_backends.direct import faults
from sim_backends.direct.cell import DirectCell
from sim_backends.direct.product import ArmSetup, CameraSetup, RailSetup, Setup, VehicleSetup


class VirtualCell(DirectCell):
    """The cell of one seed and level, and its devices behind the gate as the product takes them."""

    def __init__(
        self,
        config: CellConfig,
        seed: int,
        level: str = "nominal",
        described: Described | None = None,
        truth: CellConfig | None = None,
    ) -> None:
        """As configuration and job describe it; without one the job is `pot`.

        With `truth` the world is the cell of that configuration, and the product works on it with `config`.

        Raises `ConfigError` for an unknown level, and for what cannot be simulated as it is described.
        """
        self._truth = truth or config
        drawing = (described or Described.of("pot")).drawing(self._truth)
        try:
            super().__init__(setup_of(config), seed, level, drawing)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        # The arm's installation is right; a configuration may tell it otherwise.
        self.arm.set_payload(config.arm.payload, np.array(config.arm.payload_centre))
        self.facts = {"simulated": True, "seed": seed, "level": level, "clock": "virtual"}
        laser, claw = (connect_one(config, name, self.clock, arm=self.arm) for name in ("laser", "claw"))
        self.devices: Devices = behind_gate(
            config, self.clock, self.arm, self.rail, self.vehicle, self.scan_camera, self.target_camera, laser, claw
        )

    def require_fault(self, name: str) -> None:
        """Raise `ConfigError` for a fault that only a wire can have."""
        try:
            faults.require(name)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    def make_ready(self, described: Described) -> None:
        """See `cell.devices.simulated.Simulation`."""
        station = described.drawing(self._truth).station
        try:
            self.world.make_ready(station)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    def close(self) -> None:
        """The world ends with this object."""


def setup_of(config: CellConfig) -> Setup:
    """What the devices are given: the configuration's values and the drivers' logic."""
    arm, rail, vehicle = config.arm, of_make(config.rail, TmclRailConfig), config.vehicle
    return Setup(
        ArmSetup(
            ArmLimits(
                joint_speeds=(arm.max_joint_speed,) * 6,
                joint_acceleration=arm.max_joint_acceleration,
                linear_speed=arm.max_tool_speed,
                reach=MODELS[arm.model].reach,
                payload=MOST_PAYLOAD[arm.model],
            ),
            fault,
            safe_off_outputs(config),
        ),
        RailSetup(
            rail.lead,
            rail.steps_per_turn,
            rail.microsteps,
            rail.travel,
            rail.max_speed,
            rail.acceleration,
            rail.reversed,
            EvenMotion.of,
        ),
        VehicleSetup(
            vehicle.max_speed,
            vehicle.max_yaw_rate,
            PlanarOdometry(vehicle.track),
            lambda bits: system_trouble(bits, commanded=True),
            lambda name, bits, trouble, driven: vehicle_error(name, bits, trouble, driven=driven),
        ),
        CameraSetup(ClockMap, Latch),
    )
