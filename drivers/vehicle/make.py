"""Makes of vehicles: what every one on CAN says of its bus, `agilex`, and `fixed` where nothing drives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import model_validator

from drivers.common.addresses import checked_can
from drivers.common.units import quantity
from drivers.make import AnyMake, Make, Surroundings, VehicleConfig, real_path, with_endpoint

if TYPE_CHECKING:
    from drivers.vehicle.agilex import AgilexVehicle
    from drivers.vehicle.fixed import FixedVehicle


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


class AgilexVehicleConfig(CanVehicleConfig):
    """A carrier that speaks AgileX protocol v2 on CAN."""

    MODEL: ClassVar[str] = "AgileX v2"

    driver: Literal["agilex"] = "agilex"


class FixedVehicleConfig(VehicleConfig):
    """No vehicle: the arm stands on a fixed frame. What is said of driving is not asked for."""

    ADDRESS: ClassVar[str] = "driver"
    DRIVES: ClassVar[bool] = False
    CAUTION: ClassVar[str] = (
        "nothing drives; drive_to_target looks whether the station stands where approach.target has it, within "
        "approach.tolerance, and refuses otherwise"
    )

    driver: Literal["fixed"] = "fixed"
    track: Annotated[float, quantity("mm", 100, 3000)] = 1.0
    max_speed: Annotated[float, quantity("m/s", 0.01, 1.5)] = 1.5
    max_yaw_rate: Annotated[float, quantity("deg/s", 25, 90)] = 1.0
    lean_sigma: Annotated[float, quantity("mrad/m", 0, 20)] = 0.0

    def wire(self) -> dict[str, object]:
        return {"make": self.driver}


def _agilex(name: str, config: AgilexVehicleConfig, around: Surroundings) -> AgilexVehicle:
    from drivers.vehicle.agilex import AgilexVehicle

    return AgilexVehicle(
        name, config.interface, config.channel, bitrate=round(config.bitrate), track=config.track,
        max_speed=config.max_speed, max_yaw_rate=config.max_yaw_rate, clock=around.clock,
    )  # fmt: skip


def _fixed(name: str, config: FixedVehicleConfig, around: Surroundings) -> FixedVehicle:
    from drivers.vehicle.fixed import FixedVehicle

    return FixedVehicle(name, around.clock)


AGILEX: AnyMake = Make(
    "vehicle", "agilex", AgilexVehicleConfig, _agilex, simulated=with_endpoint("interface", "channel")
)
FIXED: AnyMake = Make("vehicle", "fixed", FixedVehicleConfig, _fixed, simulated=with_endpoint())
