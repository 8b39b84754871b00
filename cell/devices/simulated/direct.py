"""A simulated cell in this process, on a virtual clock: the world's models behind the drivers' interfaces, no wires.

It gives `sim_backends.direct` the configuration's values; what is above the devices' interfaces is the product.
"""

from typing import Any

import numpy as np

from cell.config.cell_config import DEVICES, CellConfig
from cell.devices.assembly import behind_gate, connect_one, safe_off_outputs
from cell.devices.devices import Devices
from cell.devices.simulated.described import Described
from cell.motion.kinematics import MODELS
from drivers.arm.limits import ArmLimits
from drivers.errors import ConfigError
from drivers.make import MOST_PAYLOAD
from sim_backends.direct import cell
from sim_backends.direct.cell import DirectCell, DirectSetup
from sim_backends.direct.rail import RailSetup
from sim_backends.direct.switches import DirectClaw, DirectLaser
from sim_backends.direct.vehicle import VehicleSetup


class VirtualCell(DirectCell):
    """The cell of one seed and level, and its devices behind the gate as the product takes them."""

    def __init__(
        self, config: CellConfig, seed: int, level: str = "nominal", described: Described | None = None,
        truth: CellConfig | None = None,
    ) -> None:  # fmt: skip
        """As configuration and job describe it; without one the job is `pot`.

        With `truth` the world is the cell of that configuration, and the product works on it with `config`.

        Raises `ConfigError` for an unknown level, and for what cannot be simulated as it is described.
        """
        self._config = config
        self._truth = truth or config
        drawing = (described or Described.of("pot")).drawing(self._truth)
        try:
            super().__init__(setup_of(config), seed, level, drawing)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        # The arm's installation is right; a configuration may tell it otherwise.
        self.arm.set_payload(config.arm.payload, np.array(config.arm.payload_centre))
        self.simulated = tuple(DEVICES)
        self.facts = {"simulated": True, "seed": seed, "level": level, "clock": "virtual"}
        self.devices: Devices = self.connected()

    def connected(self) -> Devices:
        """The devices as a program finds them that has just connected to them."""
        laser, claw = self._switch("laser", DirectLaser), self._switch("claw", DirectClaw)
        vehicle = self.vehicle if self._config.vehicle.DRIVES else connect_one(self._config, "vehicle", self.clock)
        return behind_gate(
            self._config, self.clock, self.arm, rail=self.rail, vehicle=vehicle, scan_camera=self.scan_camera,
            target_camera=self.target_camera, laser=laser, claw=claw,
        )  # fmt: skip

    def _switch(self, name: str, direct: type[DirectLaser | DirectClaw]) -> Any:
        """What hangs on the arm is the product's own driver; anything else is a switch of the world."""
        if self._config.make(name).on_arm:
            return connect_one(self._config, name, self.clock, arm=self.arm)
        return direct(name, self.world, self.clock)

    def require_fault(self, name: str) -> None:
        """Raise `ConfigError` for a fault that only a wire can have, or a vehicle where there is none."""
        if name.startswith("vehicle.") and not self._config.vehicle.DRIVES:
            raise ConfigError(f"{name}: the arm stands on a fixed frame, there is no vehicle that could have it")
        try:
            cell.require(name)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    def make_ready(self, described: Described) -> None:
        """See `cell.devices.simulated.process.Simulation`."""
        station = described.drawing(self._truth).station
        try:
            self.world.make_ready(station)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    def close(self) -> None:
        """The world ends with this object."""


def setup_of(config: CellConfig) -> DirectSetup:
    """What the devices are given: the configuration's values."""
    arm, rail, vehicle = config.arm, config.rail, config.vehicle
    if rail.counted is None:
        raise ConfigError(f'rail.driver = "{rail.driver}" does not say how it counts; name another make, or use wires')
    return DirectSetup(
        ArmLimits(
            joint_speeds=(arm.max_joint_speed,) * 6, joint_acceleration=arm.max_joint_acceleration,
            linear_speed=arm.max_tool_speed, reach=MODELS[arm.model].reach, payload=MOST_PAYLOAD[arm.model],
        ),
        safe_off_outputs(config),
        RailSetup(
            rail.lead, *rail.counted, rail.travel, rail.max_speed, rail.acceleration, rail.turned_round,
            rail.untold_serial,
        ),
        VehicleSetup(
            vehicle.max_speed, vehicle.max_yaw_rate, track=vehicle.track, make=vehicle.MODEL or vehicle.driver,
            count=vehicle.count_length,
        ),
    )  # fmt: skip
