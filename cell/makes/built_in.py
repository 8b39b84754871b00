"""The makes that come with the cell: their records in `cell.toml` and how each is connected.

Drivers are imported when a device is connected: reading a configuration needs none of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self, TypeVar

from pydantic import StrictBool, model_validator

from cell.base.addresses import Endpoint, Host, Port
from cell.base.units import quantity, whole
from cell.makes.cameras import FOLDER, GIGE, OPTICS, USB3, V4L2
from cell.makes.make import (
    MOST_PAYLOAD,
    AnyMake,
    ArmConfig,
    CameraConfig,
    ClawConfig,
    DeviceConfig,
    LaserConfig,
    Make,
    RailConfig,
    Surroundings,
    VehicleConfig,
)
from cell.makes.rails import MODBUS
from cell.makes.switches import SWITCH_MAKES
from cell.makes.vehicles import CANOPEN, CanVehicleConfig
from drivers.packages import lacking

if TYPE_CHECKING:
    from drivers.arm.ur import UrArm
    from drivers.camera.stream import StreamCamera
    from drivers.rail.tmcl.rail import TmclRail
    from drivers.switches import ArmSwitchedClaw, ArmSwitchedLaser
    from drivers.vehicle.agilex import AgilexVehicle
    from drivers.vehicle.fixed import FixedVehicle

MODULE_COUNTS = 2**31 - 1
"""Microsteps to which the rail's module counts, positions and microsteps per second alike."""

BAUDS = (9600, 14400, 19200, 28800, 38400, 57600, 76800, 115200, 230400, 250000, 500000, 1_000_000)
"""What the rail's module can be set to (its global parameter 65); over USB none of them matters."""
REFERENCE_MODES = (*range(1, 9), *range(65, 69), *range(133, 137))
"""Axis parameter 193 of the rail's module; +64 swaps left and right, +128 is for a home switch that opens."""
MODES_TOLD = (
    ": 1 left limit switch, 2 right then left, 3 right then both sides of the left, 4 both sides of the left, 5 home "
    "switch in negative direction turning at the left switch, 6 in positive direction turning at the right, 7 and 8 "
    "the same without the limit switches; 64 more swaps the sides of 1-4, 128 more for a home switch 5-8 that opens"
)

Connector = Annotated[int, whole(0, 17, meaning=": 0-7 standard, 8-15 configurable, 16-17 tool")]


class TmclRailConfig(RailConfig):
    """A stepper rail on a TMCL module on a serial line."""

    ADDRESS: ClassVar[str] = "url"

    driver: Literal["tmcl"] = "tmcl"
    url: Annotated[str, Port]
    address: Annotated[int, whole(1, 255)] = 1
    motor: Annotated[int, whole(0, 5)] = 0
    steps_per_turn: Annotated[int, whole(20, 2000)]
    microsteps: Annotated[int, whole(1, 256, allowed=(1, 2, 4, 8, 16, 32, 64, 128, 256))]
    baud: Annotated[int, whole(9600, 1_000_000, allowed=BAUDS)] = 9600
    reference_mode: Annotated[int, whole(1, 255, allowed=REFERENCE_MODES, meaning=MODES_TOLD)] = 5
    reversed: StrictBool = False

    @property
    def counted(self) -> tuple[int, int]:
        """See `RailConfig`."""
        return self.steps_per_turn, self.microsteps

    @property
    def turned_round(self) -> bool:
        """See `RailConfig`."""
        return self.reversed

    @model_validator(mode="after")
    def _countable(self) -> Self:
        low, high = self.travel
        counts = self.steps_per_turn * self.microsteps / self.lead
        for name, value in (
            ("travel", max(-low, high)),
            ("max_speed", self.max_speed),
            ("acceleration", self.acceleration),
        ):
            if value * counts > MODULE_COUNTS:
                raise ValueError(
                    f"{name} would be {value * counts:.3g} microsteps with this lead, steps_per_turn and microsteps; "
                    f"the module counts to {MODULE_COUNTS}. Use fewer microsteps"
                )
        return self


class UrArmConfig(ArmConfig):
    """An arm of Universal Robots' e-series."""

    driver: Literal["ur"] = "ur"
    address: Annotated[str, Host]


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
        """See `DeviceConfig`."""
        return {"make": self.driver}


class StreamCameraConfig(CameraConfig):
    """A camera on the frame stream protocol."""

    driver: Literal["stream"] = "stream"
    address: Annotated[str, Endpoint]


class OnArm(DeviceConfig):
    """A device that an output of the arm switches."""

    ADDRESS: ClassVar[str] = "output"

    output: Connector

    @property
    def place(self) -> str:
        """The arm's output."""
        return f"arm output {self.output}"


class ArmOutputLaserConfig(LaserConfig, OnArm):
    """A laser that an output of the arm switches."""

    driver: Literal["arm_output"] = "arm_output"


class ArmOutputClawConfig(ClawConfig, OnArm):
    """A claw that an output of the arm closes; an input of the arm shows a held part."""

    driver: Literal["arm_output"] = "arm_output"
    feedback: Connector


def _rail(name: str, config: TmclRailConfig, around: Surroundings) -> TmclRail:
    from drivers.rail.tmcl.rail import TmclRail

    return TmclRail(
        name,
        config.url,
        lead=config.lead,
        steps_per_turn=config.steps_per_turn,
        microsteps=config.microsteps,
        travel=config.travel,
        max_speed=config.max_speed,
        acceleration=config.acceleration,
        address=config.address,
        motor=config.motor,
        baud=config.baud,
        reference_mode=config.reference_mode,
        reversed=config.reversed,
        control=not around.look,
        clock=around.clock,
    )


def _arm(name: str, config: UrArmConfig, around: Surroundings) -> UrArm:
    from cell.motion.kinematics import MODELS
    from drivers.arm.motion import ArmLimits
    from drivers.arm.ur import UrArm

    return UrArm(
        name,
        config.address,
        clock=around.clock,
        limits=ArmLimits(
            joint_speeds=(config.max_joint_speed,) * 6,
            joint_acceleration=config.max_joint_acceleration,
            linear_speed=config.max_tool_speed,
            reach=MODELS[config.model].reach,
            payload=MOST_PAYLOAD[config.model],
        ),
        payload=(config.payload, config.payload_centre),
        safe_off_outputs=around.safe_off_outputs,
        forward_of=around.forward_of,
        control=not around.look,
        model=config.model,
    )


def _vehicle(name: str, config: AgilexVehicleConfig, around: Surroundings) -> AgilexVehicle:
    from drivers.vehicle.agilex import AgilexVehicle

    return AgilexVehicle(
        name,
        config.interface,
        config.channel,
        bitrate=round(config.bitrate),
        track=config.track,
        max_speed=config.max_speed,
        max_yaw_rate=config.max_yaw_rate,
        clock=around.clock,
    )


def _no_vehicle(name: str, config: FixedVehicleConfig, around: Surroundings) -> FixedVehicle:
    from drivers.vehicle.fixed import FixedVehicle

    return FixedVehicle(name, around.clock)


def _camera(name: str, config: StreamCameraConfig, around: Surroundings) -> StreamCamera:
    from drivers.camera.stream import StreamCamera

    return StreamCamera(name, config.address, shape=(config.height, config.width), clock=around.clock)


def _laser(name: str, config: ArmOutputLaserConfig, around: Surroundings) -> ArmSwitchedLaser:
    from drivers.switches import ArmSwitchedLaser

    return ArmSwitchedLaser(name, around.require_arm(), config.output)


def _claw(name: str, config: ArmOutputClawConfig, around: Surroundings) -> ArmSwitchedClaw:
    from drivers.switches import ArmSwitchedClaw

    return ArmSwitchedClaw(name, around.require_arm(), config.output, config.feedback, clock=around.clock)


Record = TypeVar("Record", bound=DeviceConfig)


def _with(*keys: str) -> Callable[[Record, Mapping[str, object]], Record]:
    """A record whose `keys` are those of the simulated peer."""

    def simulated(record: Record, endpoint: Mapping[str, object]) -> Record:
        return record.model_copy(update={key: endpoint[key] for key in keys})

    return simulated


BUILT_IN: tuple[AnyMake, ...] = (
    Make(
        "rail", "tmcl", TmclRailConfig, _rail, frozenset(("lead", "steps_per_turn", "microsteps")),
        calibrated_since=frozenset(("reference_mode", "reversed")), simulated=_with("url"),
    ),
    Make(
        "arm", "ur", UrArmConfig, _arm, frozenset(("model",)), simulated=_with("address"),
        missing=lambda: lacking("rtde_control", "ur-rtde"),
    ),
    Make("vehicle", "agilex", AgilexVehicleConfig, _vehicle, simulated=_with("interface", "channel")),
    Make("vehicle", "fixed", FixedVehicleConfig, _no_vehicle, simulated=_with()),
    CANOPEN,
    Make("camera", "stream", StreamCameraConfig, _camera, OPTICS, simulated=_with("address")),
    Make(
        "laser", "arm_output", ArmOutputLaserConfig, _laser, frozenset(("baseline", "tan_theta")),
        simulated=_with(), on_arm=True,
    ),
    Make("claw", "arm_output", ArmOutputClawConfig, _claw, simulated=_with(), on_arm=True),
    GIGE, USB3, V4L2, FOLDER,
    MODBUS, *SWITCH_MAKES,
)  # fmt: skip
