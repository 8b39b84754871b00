"""Vehicles on CAN: what every one of them says of its bus, and the record of two wheel drives on CANopen CiA 402."""

from __future__ import annotations

import importlib.util
import math
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import model_validator

from cell.base.addresses import checked_can
from cell.base.units import number, quantity, whole
from cell.makes.make import Make, Surroundings
from cell.makes.records import VehicleConfig, real_path

if TYPE_CHECKING:
    from drivers.vehicle.cia402.geometry import WheelDrives
    from drivers.vehicle.cia402.vehicle import CanopenVehicle

COARSEST_SPEED = 0.002
"""Largest speed of a wheel's rim, m/s, that one step of a drive's velocity may be: the vehicle creeps at 15 mm/s."""
COARSEST_COUNT = 0.0005
"""Largest way of a wheel's rim, m, that one count may be."""

Node = Annotated[int, whole(1, 127)]
Bit = Annotated[int, whole(0, 31)]


class CanVehicleConfig(VehicleConfig):
    """A carrier on a CAN bus."""

    ADDRESS: ClassVar[str] = "channel"

    interface: str
    channel: str
    bitrate: Annotated[float, quantity("kbit/s", 10, 1000)]

    @model_validator(mode="after")
    def _reachable(self) -> Self:
        checked_can(self.interface, self.channel, self.bitrate)
        return self

    @property
    def place(self) -> str:
        """The channel, without the speed of a serial line behind it."""
        return self.channel.partition("@")[0]

    @property
    def held(self) -> str:
        """Interface and channel: two interfaces may count their channels alike."""
        return f"{self.interface}:{real_path(self.place)}"


class CanopenVehicleConfig(CanVehicleConfig):
    """Two wheel drives, left and right, of CiA 402; docs/how-to/canopen.md explains each key."""

    CAUTION: ClassVar[str] = (
        "never run on a real drive: the first time with the wheels off the floor, and look which way each turns"
    )

    driver: Literal["canopen"] = "canopen"
    left_node: Node
    right_node: Node
    own_node: Node = 127
    wheel_radius: Annotated[float, quantity("mm", 20, 1000)]
    gear: Annotated[float, number(0.1, 1000)]
    counts_per_turn: Annotated[int, whole(4, 16_777_216)]
    velocity_unit: Literal["counts/s", "rpm", "0.1 rpm", "0.01 rpm", "0.001 rpm"]
    left_reversed: bool = False
    right_reversed: bool = True
    acceleration: Annotated[float, quantity("m/s^2", 0.05, 3)]
    deceleration: Annotated[float, quantity("m/s^2", 0.3, 5)]
    guarding: Literal["heartbeat", "node"] = "heartbeat"
    watchdog: Annotated[float, quantity("ms", 100, 1000)] = 0.5
    brake: Literal["drive", "output"] = "drive"
    brake_bit: Bit = 16
    brake_locks: Literal["low", "high"] = "low"
    stop_input: Bit | None = None
    stop_pressed: Literal["low", "high"] = "high"

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if len({self.left_node, self.right_node, self.own_node}) < 3:
            raise ValueError(
                f"left_node {self.left_node}, right_node {self.right_node} and own_node {self.own_node}: each node on "
                "the bus has a number of its own"
            )
        wheels = self.wheels()
        if wheels.velocity_step > COARSEST_SPEED:
            raise ValueError(
                f'velocity_unit = "{self.velocity_unit}" is {1e3 * wheels.velocity_step:.3g} mm/s at the wheel with '
                f"this gear and wheel_radius (allowed: at most {1e3 * COARSEST_SPEED:g} mm/s); set the drives to a "
                "finer unit"
            )
        if wheels.count_length > COARSEST_COUNT:
            raise ValueError(
                f"counts_per_turn {self.counts_per_turn} is {1e3 * wheels.count_length:.3g} mm of the wheel's way per "
                f"count (allowed: at most {1e3 * COARSEST_COUNT:g} mm); is it per turn of the motor, each edge counted?"
            )
        fastest = (self.max_speed + 0.5 * self.track * self.max_yaw_rate) / wheels.velocity_step
        if fastest >= 2**31:
            raise ValueError(f"max_speed would be {fastest:.3g} units of velocity; a drive takes up to {2**31 - 1}")
        turns = (self.max_speed + 0.5 * self.track * self.max_yaw_rate) * self.gear / (2 * math.pi * self.wheel_radius)
        if 60.0 * turns > MOST_RPM:
            raise ValueError(
                f"max_speed and max_yaw_rate ask {60.0 * turns:.0f} turns a minute of a motor (allowed: at most "
                f"{MOST_RPM:g}); is gear turns of the motor per turn of the wheel?"
            )
        return self

    def wheels(self) -> WheelDrives:
        """The drives as their driver takes them."""
        from drivers.vehicle.cia402.geometry import WheelDrives

        return WheelDrives(
            nodes=(self.left_node, self.right_node),
            wheel_radius=self.wheel_radius,
            gear=self.gear,
            counts=self.counts_per_turn,
            velocity_unit=self.velocity_unit,
            reversed=(self.left_reversed, self.right_reversed),
            track=self.track,
            acceleration=self.acceleration,
            deceleration=self.deceleration,
            brake_output=self.brake_bit if self.brake == "output" else None,
            brake_locks=self.brake_locks == "high",
            stop_input=self.stop_input,
            stop_active=self.stop_pressed == "high",
        )


MOST_RPM = 20_000.0
"""Of a motor that drives a wheel."""


def _canopen(name: str, config: CanopenVehicleConfig, around: Surroundings) -> CanopenVehicle:
    from drivers.vehicle.cia402.setup import Watchdog
    from drivers.vehicle.cia402.vehicle import CanopenVehicle

    return CanopenVehicle(
        name,
        config.interface,
        config.channel,
        wheels=config.wheels(),
        watchdog=Watchdog(config.guarding, config.watchdog, config.own_node),
        max_speed=config.max_speed,
        max_yaw_rate=config.max_yaw_rate,
        clock=around.clock,
        bitrate=round(config.bitrate),
        look=around.look,
    )


def _missing() -> str:
    return "" if importlib.util.find_spec("canopen") else "pip install 'assembly-cell[canopen]'"


CANOPEN: Make[CanopenVehicleConfig, CanopenVehicle] = Make(
    "vehicle",
    "canopen",
    CanopenVehicleConfig,
    _canopen,
    simulated=lambda record, endpoint: record.model_copy(
        update={key: endpoint[key] for key in ("interface", "channel")}
    ),
    missing=_missing,
)
