"""The devices of `cell.toml`, a record each: where a device is, how it is mounted and what it may do.

Ranges are those of the devices and of the drivers behind them, so that what passes here can be asked of them.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

import numpy as np
import pinocchio as pin
from pydantic import AfterValidator, model_validator

from cell.addresses import Endpoint, Host, Port, checked_can
from cell.toml_file import Table
from cell.units import number, quantity, whole
from drivers.errors import ConfigError

MODULE_COUNTS = 2**31 - 1
"""Microsteps to which the rail's module counts, positions and microsteps per second alike."""

Length = Annotated[float, quantity("mm", -20_000, 20_000)]
Offset = Annotated[float, quantity("mm", -1_000, 1_000)]
Angle = Annotated[float, quantity("deg", -360, 360)]
Connector = Annotated[int, whole(0, 17, meaning=": 0-7 standard, 8-15 configurable, 16-17 tool")]
Pixels = Annotated[int, whole(64, 8192)]
Exposure = Annotated[float, quantity("ms", 0.01, 1000)]
PhotoExposure = Annotated[float, quantity("ms", 0.01, 100)]
"""Of a photograph, which is taken at 10 Hz."""
Scatter = Annotated[float, quantity("mm", 0.0001, 2)]
AngleScatter = Annotated[float, quantity("mrad", 0.0001, 10)]


class Pose(Table):
    """A pose as translation and roll-pitch-yaw about the fixed axes x, y, z (R = Rz Ry Rx)."""

    translation: tuple[Length, Length, Length]
    rotation: tuple[Angle, Angle, Angle]

    def se3(self) -> pin.SE3:
        """The pose as `pin.SE3`, m."""
        return pin.SE3(pin.rpy.rpyToMatrix(*self.rotation), np.array(self.translation))


class Mounting(Pose):
    """The pose of something that is screwed on: no more than a metre away."""

    translation: tuple[Offset, Offset, Offset]


Travel = Annotated[float, quantity("mm", -100, 2_000)]


class RailConfig(Table):
    """The stepper rail, a TMCL module on a serial line."""

    driver: Literal["tmcl"] = "tmcl"
    url: Annotated[str, Port]
    address: Annotated[int, whole(1, 255)] = 1
    motor: Annotated[int, whole(0, 5)] = 0
    lead: Annotated[float, quantity("mm", 0.1, 50)]
    steps_per_turn: Annotated[int, whole(20, 2000)]
    microsteps: Annotated[int, whole(1, 256, 1, 2, 4, 8, 16, 32, 64, 128, 256)]
    travel: tuple[Travel, Travel]
    max_speed: Annotated[float, quantity("mm/s", 0.1, 500)]
    acceleration: Annotated[float, quantity("mm/s^2", 1, 10_000)]

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.travel
        if not high - low >= 0.01:
            raise ValueError(f"travel {low * 1e3:g} to {high * 1e3:g} mm: the first must be smaller, by 10 mm or more")
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


Centre = Annotated[float, quantity("mm", -500, 500)]


class ArmConfig(Table):
    """The arm and where it stands on the vehicle."""

    driver: Literal["ur"] = "ur"
    model: Literal["UR10e"] = "UR10e"
    address: Annotated[str, Host]
    max_joint_speed: Annotated[float, quantity("deg/s", 1, 120)]
    max_joint_acceleration: Annotated[float, quantity("deg/s^2", 1, 800)]
    max_joint_jerk: Annotated[float, quantity("deg/s^3", 10, 40_000)]
    max_tool_speed: Annotated[float, quantity("mm/s", 1, 1500)]
    payload: Annotated[float, quantity("kg", 0, 12.5)]
    payload_centre: tuple[Centre, Centre, Centre]
    vehicle_from_base: Pose
    settle_time: Annotated[float, quantity("s", 0, 5)]
    repeatability: Scatter
    repeatability_angle: AngleScatter
    kinematic_sigma: Annotated[float, quantity("mm", 0, 10)]
    kinematic_sigma_angle: Annotated[float, quantity("mrad", 0, 10)]

    @model_validator(mode="after")
    def _on_the_vehicle(self) -> Self:
        stand = self.vehicle_from_base.se3()
        x, y, z = stand.translation
        if max(abs(x), abs(y)) > 2.0 or not 0.0 <= z <= 2.0:
            raise ValueError(
                f"vehicle_from_base.translation ({1e3 * x:g}, {1e3 * y:g}, {1e3 * z:g}) mm puts the arm off the "
                "vehicle (allowed: -2000 to 2000 mm ahead and aside, 0 to 2000 mm above the floor)"
            )
        if stand.rotation[2, 2] < math.cos(math.radians(5.0)):
            raise ValueError("vehicle_from_base.rotation tilts the arm; it has to stand upright to within 5 deg")
        return self


class VehicleConfig(Table):
    """The carrier, AgileX protocol v2 on CAN."""

    driver: Literal["agilex"] = "agilex"
    interface: str
    channel: str
    bitrate: Annotated[float, quantity("kbit/s", 10, 1000)]
    track: Annotated[float, quantity("mm", 100, 3000)]
    max_speed: Annotated[float, quantity("m/s", 0.01, 1.5)]
    max_yaw_rate: Annotated[float, quantity("deg/s", 25, 90)]
    lean_sigma: Annotated[float, quantity("mrad/m", 0, 20)] = 0.0004

    @model_validator(mode="after")
    def _reachable(self) -> Self:
        checked_can(self.interface, self.channel, self.bitrate)
        return self


class CameraConfig(Table):
    """A camera on the frame stream protocol, with its nominal optics and mounting."""

    driver: Literal["stream"] = "stream"
    address: Annotated[str, Endpoint]
    width: Pixels
    height: Pixels
    pixel: Annotated[float, quantity("um", 0.5, 30)]
    focal_length: Annotated[float, quantity("mm", 1, 200)]
    flange_from_camera: Mounting
    photo_exposure: PhotoExposure

    @model_validator(mode="after")
    def _sees(self) -> Self:
        sides = self.width, self.height
        if max(sides) > 4 * min(sides):
            raise ValueError(
                f"{self.width} x {self.height} pixels is no shape of a sensor: one side is over 4 times the other"
            )
        field = 2 * math.degrees(math.atan(0.5 * max(sides) * self.pixel / self.focal_length))
        if not 1.0 <= field <= 120.0:
            raise ValueError(
                f"width, height, pixel and focal_length make a field of view of {field:.2g} deg (allowed: 1 to 120 "
                "deg); correct the one that is wrong"
            )
        return self


class LaserConfig(Table):
    """The line laser: the arm's output that switches it, and its nominal place in the scan camera's frame."""

    output: Connector
    baseline: Annotated[float, quantity("mm", 5, 500)]
    tan_theta: Annotated[float, number(0.2, 20)]


class ClawConfig(Table):
    """The claw: the arm's output that closes it and the input that shows a held part."""

    output: Connector
    feedback: Connector


class PlateConfig(Table):
    """A calibration board fixed on the vehicle's deck."""

    board: Annotated[str, AfterValidator(lambda text: checked_board(text))]
    base_from_board: Pose


class CalibrationConfig(Table):
    """How the cell calibrates itself."""

    fine: PlateConfig
    large: PlateConfig
    max_age: Annotated[float, quantity("day", 0.01, 3650)]
    stripe_exposure: PhotoExposure
    rail_sigma: Scatter


def checked_board(text: str) -> str:
    """A board's name, once it is known to be well formed."""
    from cell.vision.board.spec import parse_board

    try:
        parse_board(text)
    except ConfigError as error:
        raise ValueError(str(error)) from error
    return text
