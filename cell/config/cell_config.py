"""`cell.toml`: which devices the cell has, where they are and what they may do, and what it draws as bodies.

Every value carries its unit and is checked against its range here, once. Unknown keys are refused. The hash of what a
calibration depends on ties stored calibrations to the configuration that they were made under. Obstacles are boxes that
a configuration (on the vehicle) or a job (at the station) names: arm and vehicle keep away from them.
"""

import hashlib
import json
import tomllib
from collections.abc import Collection, Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import pinocchio as pin
from pydantic import AfterValidator, SerializeAsAny, WrapValidator, model_validator

from cell.base.toml_file import read_toml, validate
from cell.config.files import CONFIGURATION, DEVICES, RUNS, beside, find_config, runs_folder
from cell.makes import BUILT_IN, make_of, record_of
from cell.measure.geometry.poses import from_parts
from cell.measure.vision.board.view import centre_of, parse_board
from cell.motion.collision import BASE, Body, Mounted, box
from drivers.common.addresses import Folder, Name, checked_endpoint, checked_folder, is_example
from drivers.common.units import number, quantity, shown
from drivers.errors import ConfigError
from drivers.make import (
    AnyMake,
    ArmConfig,
    CameraConfig,
    ClawConfig,
    DeviceConfig,
    LaserConfig,
    PhotoExposure,
    Pose,
    RailConfig,
    Scatter,
    Table,
    VehicleConfig,
)
from drivers.relay.make import line_problems


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
    each_job: bool = True


def checked_board(text: str) -> str:
    """A board's name, once it is known to be well formed."""
    try:
        parse_board(text)
    except ConfigError as error:
        raise ValueError(str(error)) from error
    return text


Side = Annotated[float, quantity("mm", 1, 10_000)]


class Obstacle(Table):
    """A box with edges `size` along the axes of its pose, which is that of its middle."""

    name: Annotated[str, Name]
    size: tuple[Side, Side, Side]


class VehicleObstacle(Obstacle):
    """One that goes with the vehicle: a control box, a rack."""

    base_from_centre: Pose


class StationObstacle(Obstacle):
    """One that stands at the station: a fixture, a neighbour's machine."""

    place_from_centre: Pose


def once_each(what: str, names: Sequence[str]) -> None:
    """Raise `ValueError` when two tables, `what` in words, have one of these names."""
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{what} {', '.join(twice)} is there twice; give each a name of its own")


def vehicle_obstacles(obstacles: Iterable[VehicleObstacle]) -> list[Body]:
    """The bodies of those on the vehicle, fixed to the arm's base."""
    return [box(f"obstacle {o.name}", BASE, o.base_from_centre.se3(), o.size) for o in obstacles]


def station_obstacles(obstacles: Iterable[StationObstacle], base_from_place: pin.SE3) -> list[Body]:
    """The bodies of those at the station, by the place frame's pose in the arm base."""
    return [
        box(f"station obstacle {o.name}", BASE, base_from_place * o.place_from_centre.se3(), o.size) for o in obstacles
    ]


__all__ = [
    "CONFIGURATION", "DEVICES", "ArmConfig", "CameraConfig", "CellConfig", "RailConfig", "VehicleConfig", "beside",
    "default_toml", "find_config", "load_config", "runs_folder", "validate",
]  # fmt: skip

Confirm = Literal["person", "simulated"]
"""Who confirms what a person has to: a person, or the simulated cell itself."""
NO_FILES = {"record": False, "frames": False, "picture": False}
"""What a campaign changes in [cell]: its runs leave their report and journal alone."""
CALIBRATION_DEPTHS = {"fine": (0.120, 0.130, 0.142), "large": (0.560, 0.650, 0.700)}
"""Nearest, usual and farthest distance of the calibration's views, m."""


class CellSection(Table):
    """The cell as a whole."""

    name: Annotated[str, Name]
    runs: Annotated[str, Folder] = RUNS
    calibrations: Annotated[str, Folder] = "calibrations"
    time_scale: Annotated[float, number(0.01, 100)] = 1.0
    truth: Annotated[str, AfterValidator(lambda text: text and checked_endpoint(text))] = ""
    confirm: Confirm = "person"
    record: bool = True
    frames: bool = True
    """Whether runs keep the pictures that they look at. Without them no sweep is used again after a resume."""
    picture: bool = True
    """Whether runs draw `picture.png`; campaigns of many runs leave it out."""
    meshes: Annotated[str, AfterValidator(lambda text: text and checked_folder(text))] = ""
    """A folder of the links' meshes for the 3-D scene, beside this file; empty for none."""
    sim: Annotated[tuple[str, ...], AfterValidator(lambda names: _devices(names))] = ()
    """The devices that are simulated beside real ones."""

    @model_validator(mode="after")
    def _real_time(self) -> Self:
        if self.runs == self.calibrations:
            raise ValueError(f'runs and calibrations are both "{self.runs}"; each needs a folder of its own')
        if self.time_scale != 1.0 and not self.truth:
            raise ValueError(
                f"time_scale {self.time_scale:g} is only for a simulated cell, whose truth has an address; "
                "real devices need time_scale = 1"
            )
        return self


def _devices(names: tuple[str, ...]) -> tuple[str, ...]:
    if unknown := [name for name in names if name not in DEVICES]:
        raise ValueError(f"there is no device {', '.join(unknown)}; the devices are {', '.join(DEVICES)}")
    return names


class CellConfig(Table):
    """The whole configuration, as typed and checked records; a device's record is that of its make."""

    cell: CellSection
    rail: Annotated[SerializeAsAny[RailConfig], WrapValidator(record_of("rail"))]
    arm: Annotated[SerializeAsAny[ArmConfig], WrapValidator(record_of("arm"))]
    vehicle: Annotated[SerializeAsAny[VehicleConfig], WrapValidator(record_of("vehicle"))]
    scan_camera: Annotated[SerializeAsAny[CameraConfig], WrapValidator(record_of("camera"))]
    target_camera: Annotated[SerializeAsAny[CameraConfig], WrapValidator(record_of("camera"))]
    laser: Annotated[SerializeAsAny[LaserConfig], WrapValidator(record_of("laser"))]
    claw: Annotated[SerializeAsAny[ClawConfig], WrapValidator(record_of("claw"))]
    calibration: CalibrationConfig
    obstacle: tuple[VehicleObstacle, ...] = ()

    @model_validator(mode="after")
    def _distinct_obstacles(self) -> Self:
        once_each("obstacle", [obstacle.name for obstacle in self.obstacle])
        return self

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        found: dict[str, str] = {}
        places = {f"{name}.{self.device(name).ADDRESS}": self.device(name).place for name in DEVICES}
        for key, place in (*places.items(), ("cell.truth", self.cell.truth)):
            other = found.setdefault(place.lower(), key)
            if place and other != key:
                raise ValueError(f"{other} and {key} are both {shown(place)}; each device has an address of its own")
        if problem := next(line_problems({name: self.device(name) for name in DEVICES}), None):
            raise ValueError(problem)
        return self

    def device(self, name: str) -> DeviceConfig:
        """The record of the device of that name."""
        record: DeviceConfig = getattr(self, name)
        return record

    def make(self, name: str) -> AnyMake:
        """The make of the device of that name."""
        return make_of(DEVICES[name], self.device(name).driver)

    def calibration_hash(self) -> str:
        """Hash of everything that a calibration depends on: boards, and what each device's make says, not addresses."""
        parts = {"calibration": self.calibration.model_dump(include={"fine", "large"})}
        for name, kind in DEVICES.items():
            make = self.make(name)
            if make.calibrated:
                record = self.device(name)
                since = record.model_dump(include=set(make.calibrated_since), exclude_defaults=True)
                parts[name] = {**record.model_dump(include=set(make.calibrated)), **since}
            if make not in BUILT_IN:
                parts[name] = {**parts.get(name, {}), "driver": f"{kind}.{make.name}"}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def default_toml() -> str:
    """Text of the configuration that ships, with the simulated cell's nominal geometry."""
    return files("cell").joinpath("defaults", "cell.toml").read_text(encoding="utf-8")


def load_config(path: Path | None) -> CellConfig:
    """Read and check a configuration; without a path, the one that ships. Raises `ConfigError`."""
    return validate(CellConfig, tables_of(path), "the default configuration" if path is None else str(path))


def tables_of(path: Path | None) -> dict[str, object]:
    """The tables of a configuration as they are written; without a path, of the one that ships."""
    return tomllib.loads(default_toml()) if path is None else read_toml(path, "configuration", "cell init")


def example_addresses(config: CellConfig) -> list[str]:
    """The keys whose addresses are still those of the example, which no device has."""
    records = {name: config.device(name) for name in DEVICES}
    return [f'{name}.{r.ADDRESS} = "{r.place}"' for name, r in records.items() if is_example(r.place)]


def require_real_addresses(config: CellConfig, simulated: Collection[str] = ()) -> None:
    """Raise `ConfigError` when an address is still the example's, but for these: before devices are connected."""
    if found := [text for text in example_addresses(config) if text.partition(".")[0] not in simulated]:
        raise ConfigError(f"{', '.join(found)}: still the example's, where no device is; write your cell's own")


def require_confirm(config: CellConfig) -> None:
    """Raise `ConfigError` when a cell that is not simulated is to confirm by itself what a person has to."""
    if config.cell.confirm == "simulated" and not config.cell.truth:
        raise ConfigError(
            'cell.confirm = "simulated" is only for a simulated cell (one that gives cell.truth, or --sim all): at a '
            'real one a person looks and confirms; write confirm = "person" or leave it out'
        )
    if config.cell.confirm == "simulated" and not config.arm.place.startswith(("127.", "localhost")):
        raise ConfigError(
            f'cell.confirm = "simulated", but the arm at {config.arm.place} is not on this machine, so it '
            'may be a real one; write confirm = "person" or leave it out'
        )


def config_to_open(
    path: Path | None, *, simulated: bool, confirm: Confirm | None = None
) -> tuple[Path | None, CellConfig]:
    """The file (None: the one that ships) and the configuration to connect devices with, or a simulated cell.

    `confirm`, if given, stands for `cell.confirm`. Raises `ConfigError` as `find_config`, `load_config`, and, where
    devices are real, `require_confirm` do; `require_real_addresses` is left to who knows which those are.
    """
    source = find_config(path, simulated=simulated)
    config = load_config(source)
    if confirm is not None:
        config = config.model_copy(update={"cell": config.cell.model_copy(update={"confirm": confirm})})
    if not simulated:
        require_confirm(config)
    return source, config


PLATE_THICKNESS = 0.01
"""Of a calibration board, m."""


def mounted(config: CellConfig) -> Mounted:
    """What the flange carries beside the claw, where the configuration has it."""
    scan, target = (camera.flange_from_camera.se3() for camera in (config.scan_camera, config.target_camera))
    return Mounted(scan, target, config.laser.baseline, config.rail.travel)


def deck_plates(config: CellConfig) -> list[tuple[str, pin.SE3, tuple[float, float, float]]]:
    """The calibration boards on the deck: name, base_from_centre and size, m."""
    plates = []
    for name, plate in (("fine plate", config.calibration.fine), ("large board", config.calibration.large)):
        board = parse_board(plate.board)
        width, height = np.ptp(board.points()[:, :2], axis=0) + 2 * board.pitch
        below = from_parts(centre_of(board) + np.array([0.0, 0.0, PLATE_THICKNESS / 2]))
        plates.append((name, plate.base_from_board.se3() * below, (width, height, PLATE_THICKNESS)))
    return plates
