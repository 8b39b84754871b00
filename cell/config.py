"""`cell.toml`: which devices the cell has, where they are and what they may do.

Every value carries its unit and is checked against its range here, once. Unknown keys are refused. The hash of what a
calibration depends on ties stored calibrations to the configuration that they were made under.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
import pinocchio as pin
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from cell.units import quantity
from drivers.errors import ConfigError

T = TypeVar("T", bound=BaseModel)
Length = Annotated[float, quantity("mm", -20_000, 20_000)]
Angle = Annotated[float, quantity("deg", -360, 360)]
Mass = Annotated[float, quantity("kg", 0, 50)]
Output = Annotated[int, Field(ge=0, le=17)]
Sigma = Annotated[float, quantity("mm", 0, 100)]


class Table(BaseModel):
    """A TOML table: frozen, and with no keys but the known ones."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Pose(Table):
    """A pose as translation and roll-pitch-yaw about the fixed axes x, y, z (R = Rz Ry Rx)."""

    translation: tuple[Length, Length, Length]
    rotation: tuple[Angle, Angle, Angle]

    def se3(self) -> pin.SE3:
        """The pose as `pin.SE3`, m."""
        return pin.SE3(pin.rpy.rpyToMatrix(*self.rotation), np.array(self.translation))


class RailConfig(Table):
    """The stepper rail, a TMCL module on a serial line."""

    driver: Literal["tmcl"] = "tmcl"
    url: str = Field(min_length=1)
    address: Annotated[int, Field(ge=1, le=255)] = 1
    motor: Annotated[int, Field(ge=0, le=5)] = 0
    lead: Annotated[float, quantity("mm", 0.1, 50)]
    steps_per_turn: Annotated[int, Field(ge=20, le=2000)]
    microsteps: Literal[1, 2, 4, 8, 16, 32, 64, 128, 256]
    travel: tuple[Length, Length]
    max_speed: Annotated[float, quantity("mm/s", 0.1, 500)]
    acceleration: Annotated[float, quantity("mm/s^2", 1, 10_000)]

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.travel[0] < self.travel[1]:
            raise ValueError(
                f"travel {self.travel[0] * 1e3:g} to {self.travel[1] * 1e3:g} mm: the first must be smaller"
            )
        return self


class ArmConfig(Table):
    """The arm and where it stands on the vehicle."""

    driver: Literal["ur"] = "ur"
    model: Literal["UR10e"] = "UR10e"
    address: str = Field(min_length=1)
    max_joint_speed: Annotated[float, quantity("deg/s", 1, 120)]
    max_joint_acceleration: Annotated[float, quantity("deg/s^2", 1, 800)]
    max_joint_jerk: Annotated[float, quantity("deg/s^3", 10, 40_000)]
    max_tool_speed: Annotated[float, quantity("mm/s", 1, 1500)]
    payload: Mass
    payload_centre: tuple[Length, Length, Length]
    vehicle_from_base: Pose
    settle_time: Annotated[float, quantity("s", 0, 5)]
    repeatability: Sigma
    repeatability_angle: Annotated[float, quantity("mrad", 0, 10)]
    kinematic_sigma: Sigma
    kinematic_sigma_angle: Annotated[float, quantity("mrad", 0, 10)]


class VehicleConfig(Table):
    """The carrier, AgileX protocol v2 on CAN."""

    driver: Literal["agilex"] = "agilex"
    interface: str = Field(min_length=1)
    channel: str = Field(min_length=1)
    bitrate: Annotated[float, quantity("kbit/s", 10, 1000)]
    track: Annotated[float, quantity("mm", 100, 3000)]
    max_speed: Annotated[float, quantity("m/s", 0.01, 1.5)]
    max_yaw_rate: Annotated[float, quantity("deg/s", 1, 90)]
    lean_sigma: Annotated[float, quantity("mrad/m", 0, 20)] = 0.0004


class CameraConfig(Table):
    """A camera on the frame stream protocol, with its nominal optics and mounting."""

    driver: Literal["stream"] = "stream"
    address: str = Field(min_length=1)
    width: Annotated[int, Field(ge=64, le=8192)]
    height: Annotated[int, Field(ge=64, le=8192)]
    pixel: Annotated[float, quantity("um", 0.5, 30)]
    focal_length: Annotated[float, quantity("mm", 1, 200)]
    flange_from_camera: Pose
    photo_exposure: Annotated[float, quantity("ms", 0.01, 1000)]


class LaserConfig(Table):
    """The line laser: the arm's output that switches it, and its nominal place in the scan camera's frame."""

    output: Output
    baseline: Annotated[float, quantity("mm", 5, 500)]
    tan_theta: Annotated[float, Field(ge=0.2, le=20)]


class ClawConfig(Table):
    """The claw: the arm's output that closes it and the input that shows a held part."""

    output: Output
    feedback: Annotated[int, Field(ge=0, le=17)]


class PlateConfig(Table):
    """A calibration board fixed on the vehicle's deck."""

    board: Annotated[str, AfterValidator(lambda text: checked_board(text))]
    base_from_board: Pose


class CalibrationConfig(Table):
    """How the cell calibrates itself."""

    fine: PlateConfig
    large: PlateConfig
    max_age: Annotated[float, quantity("day", 0.01, 3650)]
    stripe_exposure: Annotated[float, quantity("ms", 0.01, 1000)]
    rail_sigma: Sigma


class CellSection(Table):
    """The cell as a whole."""

    name: str = Field(min_length=1, max_length=64)
    runs: str = "runs"
    calibrations: str = "calibrations"
    time_scale: Annotated[float, Field(gt=0, le=100)] = 1.0
    truth: str = ""


class CellConfig(Table):
    """The whole configuration, as typed and checked records."""

    cell: CellSection
    rail: RailConfig
    arm: ArmConfig
    vehicle: VehicleConfig
    scan_camera: CameraConfig
    target_camera: CameraConfig
    laser: LaserConfig
    claw: ClawConfig
    calibration: CalibrationConfig

    @model_validator(mode="after")
    def _distinct_outputs(self) -> Self:
        if self.laser.output == self.claw.output:
            raise ValueError(
                f"laser.output and claw.output are both {self.laser.output}; each needs an output of its own"
            )
        return self

    def calibration_hash(self) -> str:
        """Hash of everything that a calibration depends on: optics, mounting, rail and boards, not addresses."""
        parts = {
            "rail": self.rail.model_dump(include={"lead", "steps_per_turn", "microsteps"}),
            "arm": self.arm.model_dump(include={"model"}),
            "scan_camera": self.scan_camera.model_dump(exclude={"address", "driver", "photo_exposure"}),
            "target_camera": self.target_camera.model_dump(exclude={"address", "driver", "photo_exposure"}),
            "laser": self.laser.model_dump(exclude={"output"}),
            "calibration": self.calibration.model_dump(include={"fine", "large"}),
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def checked_board(text: str) -> str:
    """A board's name, once it is known to be well formed."""
    from cell.vision.board_spec import parse_board

    try:
        parse_board(text)
    except ConfigError as error:
        raise ValueError(str(error)) from error
    return text


def default_toml() -> str:
    """Text of the configuration that ships, with the simulated cell's nominal geometry."""
    return files("cell").joinpath("defaults", "cell.toml").read_text(encoding="utf-8")


def load_config(path: Path | None) -> CellConfig:
    """Read and check a configuration; without a path, the one that ships. Raises `ConfigError`."""
    if path is None:
        return validate(CellConfig, tomllib.loads(default_toml()), "the default configuration")
    return validate(CellConfig, read_toml(path, "configuration", "cell init"), str(path))


def read_toml(path: Path, what: str, how_to_make: str) -> dict[str, Any]:
    """Parse a TOML file; every way that this fails is a `ConfigError` that names the file."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"{what} {path} does not exist; `{how_to_make}` writes one to start from") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{what} {path} cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{what} {path} is not valid TOML: {error}") from error


def validate(kind: type[T], data: dict[str, Any], where: str) -> T:
    """Check parsed data against a record type; all problems go into one `ConfigError`, a line each."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        lines = []
        for problem in error.errors():
            key = ".".join(str(part) for part in problem["loc"]) or "(whole file)"
            lines.append(f"  {key}: {_wording(problem)}")
        raise ConfigError(f"{where} is not valid:\n" + "\n".join(lines)) from error


def _wording(problem: Any) -> str:
    kind, value, context = problem["type"], problem.get("input"), problem.get("ctx", {})
    if kind == "extra_forbidden":
        return "unknown key; check its spelling or remove it"
    if kind == "missing":
        return "missing; `cell init` writes a complete file to compare with"
    if kind == "value_error":
        return str(context.get("error", problem["msg"]))
    return f"{value!r} is not accepted: {problem['msg']}"
