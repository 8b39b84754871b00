"""What a make is: everything that the cell has to know to work with one product behind one of its devices.

A package brings a make by an entry point of the group `assembly_cell.devices`, named KIND.NAME, that leads to a `Make`.
The makes that come with the cell are in `make.py` beside their drivers. Reading a configuration imports only these.

The records here hold what the cell has to know of each kind of device: how it is mounted and what it may do. A make's
record adds where the device is and how it is set up. Ranges are those of the devices."""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Generic, Literal, Self, TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator, model_validator

from drivers.clock import Clock
from drivers.common.units import number, quantity, whole
from drivers.errors import ConfigError
from drivers.interfaces import Arm, Device, LinkTable, Vector

Length = Annotated[float, quantity("mm", -20_000, 20_000)]
Offset = Annotated[float, quantity("mm", -1_000, 1_000)]
Angle = Annotated[float, quantity("deg", -360, 360)]
Pixels = Annotated[int, whole(64, 8192)]
Exposure = Annotated[float, quantity("ms", 0.01, 1000)]
PhotoExposure = Annotated[float, quantity("ms", 0.01, 100)]
"""Of a photograph, which is taken at 10 Hz."""
Scatter = Annotated[float, quantity("mm", 0.0001, 2)]
AngleScatter = Annotated[float, quantity("mrad", 0.0001, 10)]


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


class Mounting(Pose):
    """The pose of something that is screwed on: no more than a metre away."""

    translation: tuple[Offset, Offset, Offset]


def real_path(address: str) -> str:
    """A device file by the name of what it is, whichever link to it the configuration names; others as they are."""
    return os.path.realpath(address) if address.startswith("/") else address


class DeviceConfig(Table):
    """A device's table: `driver` names its make, `ADDRESS` is the key that says where the device is.

    `CAUTION` is what a person has to know of devices of this make before relying on them; `cell check` says it.
    """

    ADDRESS: ClassVar[str] = "address"
    CAUTION: ClassVar[str] = ""

    driver: str

    @property
    def place(self) -> str:
        """Where the device is: no other device of the cell is there."""
        return str(getattr(self, self.ADDRESS))

    @property
    def held(self) -> str:
        """What this computer knows the device by: one program at a time holds it."""
        return real_path(self.place)

    def wire(self) -> dict[str, object]:
        """How the device is wired, as its simulated peer takes it; empty where no peer has to be told."""
        return {}

    def answers(self) -> tuple[str, bool] | None:
        """Whether the device answers where it is, in words; nothing is set. None: it is asked as any address."""
        return None


OfMake = TypeVar("OfMake", bound=DeviceConfig)


def of_make(record: DeviceConfig, kind: type[OfMake]) -> OfMake:
    """The record as that of one make; `ConfigError` when it is another's."""
    if not isinstance(record, kind):
        raise ConfigError(f'driver = "{record.driver}" does not work here: a device of {kind.__name__} is needed')
    return record


Travel = Annotated[float, quantity("mm", -100, 2_000)]


Late = Annotated[float, quantity("ms", 0, 100)]


class RailConfig(DeviceConfig):
    """A rail; `lead` is the travel per turn of its motor.

    `late`: by how much older a position may be than the moment at which it was asked for; nobody can see that from
    outside.
    """

    lead: Annotated[float, quantity("mm", 0.1, 50)]
    travel: tuple[Travel, Travel]
    max_speed: Annotated[float, quantity("mm/s", 0.1, 500)]
    acceleration: Annotated[float, quantity("mm/s^2", 1, 10_000)]
    late: Late = 0.0

    @property
    def counted(self) -> tuple[int, int] | None:
        """Steps of a turn that the drive counts, and microsteps of a step; None where the make does not say."""
        return None

    @property
    def turned_round(self) -> bool:
        """Whether the drive is to turn its motor the other way round."""
        return False

    @property
    def untold_serial(self) -> str | None:
        """What stands for the serial number of a drive that tells none; None for one that tells it."""
        return None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.travel
        if not high - low >= 0.01:
            raise ValueError(f"travel {low * 1e3:g} to {high * 1e3:g} mm: the first must be smaller, by 10 mm or more")
        return self


MOST_PAYLOAD = {
    "UR3": 3.0, "UR5": 5.0, "UR10": 10.0, "UR3e": 3.0, "UR5e": 5.0, "UR7e": 7.5, "UR10e": 12.5, "UR12e": 12.5,
    "UR16e": 16.0, "UR20": 20.0, "UR30": 30.0,
}  # fmt: skip
"""What each model carries, kg, by the maker's data sheets."""
Centre = Annotated[float, quantity("mm", -500, 500)]


class ArmConfig(DeviceConfig):
    """The arm and where it stands on the vehicle.

    The cell plans with the table that the arm's controller tells; it has to be that of an arm of `model`.
    """

    model: Literal["UR3", "UR5", "UR10", "UR3e", "UR5e", "UR7e", "UR10e", "UR12e", "UR16e", "UR20", "UR30"] = "UR10e"
    max_joint_speed: Annotated[float, quantity("deg/s", 1, 120)]
    max_joint_acceleration: Annotated[float, quantity("deg/s^2", 1, 800)]
    max_joint_jerk: Annotated[float, quantity("deg/s^3", 10, 40_000)]
    max_tool_speed: Annotated[float, quantity("mm/s", 1, 1500)]
    payload: Annotated[float, quantity("kg", 0, 30)]
    payload_centre: tuple[Centre, Centre, Centre]
    vehicle_from_base: Pose
    settle_time: Annotated[float, quantity("s", 0, 5)]
    repeatability: Scatter
    repeatability_angle: AngleScatter
    kinematic_sigma: Annotated[float, quantity("mm", 0, 10)]
    kinematic_sigma_angle: Annotated[float, quantity("mrad", 0, 10)]

    @field_validator("payload")
    @classmethod
    def _carries(cls, payload: float, others: ValidationInfo) -> float:
        model = others.data.get("model")
        if model is not None and payload > (most := MOST_PAYLOAD[model]):
            raise ValueError(f"{payload:g} kg is outside of 0 to {most:g} kg, what a {model} carries")
        return payload

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


class VehicleConfig(DeviceConfig):
    """The carrier. One that does not drive (`DRIVES`) stands at the target of every job. As it turns, its wheels slide
    sideways (`SLIDES`) or roll. `MODEL` is what the make calls itself; without it that is `driver`."""

    DRIVES: ClassVar[bool] = True
    SLIDES: ClassVar[bool] = True
    MODEL: ClassVar[str] = ""

    track: Annotated[float, quantity("mm", 100, 3000)]
    max_speed: Annotated[float, quantity("m/s", 0.01, 1.5)]
    max_yaw_rate: Annotated[float, quantity("deg/s", 25, 90)]
    lean_sigma: Annotated[float, quantity("mrad/m", 0, 20)] = 0.0004

    @property
    def count_length(self) -> float:
        """In what the way of a side is told, m."""
        return 0.001


class FilterConfig(Table):
    """A band-pass filter before a lens: the middle of what it passes, how wide that is (FWHM), and its transmission."""

    centre: Annotated[float, quantity("nm", 300, 1100)]
    width: Annotated[float, quantity("nm", 1, 400)]
    transmission: Annotated[float, number(0.01, 1)]


class CameraConfig(DeviceConfig):
    """A camera with its nominal optics and mounting.

    `filter`: the band-pass before its lens; None without one. `late`: by how much its time stamps may come after the
    exposures really began; nobody can see that from outside.
    """

    width: Pixels
    height: Pixels
    pixel: Annotated[float, quantity("um", 0.5, 30)]
    focal_length: Annotated[float, quantity("mm", 1, 200)]
    flange_from_camera: Mounting
    photo_exposure: PhotoExposure
    late: Late = 0.002
    filter: FilterConfig | None = None

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


OPTICS = frozenset(("width", "height", "pixel", "focal_length", "flange_from_camera"))
"""On these a calibration depends, whatever the camera's make."""
OPTICS_SINCE = frozenset(("filter",))


class LaserConfig(DeviceConfig):
    """The line laser with its nominal place in the scan camera's frame.

    `witness`: where the rail shows the scan camera the line on a plate that is fixed to the claw; None without one.
    """

    baseline: Annotated[float, quantity("mm", 5, 500)]
    tan_theta: Annotated[float, number(0.2, 20)]
    witness: Annotated[float, quantity("mm", -2000, 2000)] | None = None

    @property
    def exit_point(self) -> NDArray[np.float64]:
        """The laser's exit point (3,) in the scan camera's frame as drawn, m."""
        return np.array([-self.baseline, 0.0, 0.0])


class ClawConfig(DeviceConfig):
    """The claw."""


Connector = Annotated[int, whole(0, 17, meaning=": 0-7 standard, 8-15 configurable, 16-17 tool")]


class OnArm(DeviceConfig):
    """A device that an output of the arm switches."""

    ADDRESS: ClassVar[str] = "output"

    output: Connector

    @property
    def place(self) -> str:
        """The arm's output."""
        return f"arm output {self.output}"


KINDS: dict[str, type[DeviceConfig]] = {
    "rail": RailConfig,
    "arm": ArmConfig,
    "vehicle": VehicleConfig,
    "camera": CameraConfig,
    "laser": LaserConfig,
    "claw": ClawConfig,
}
"""Kinds of devices, and what the record of any make of that kind derives from."""

Record = TypeVar("Record", bound=DeviceConfig)
Connected = TypeVar("Connected", bound=Device)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a device is connected with, besides its own record.

    `look`: nothing on the device is to be set, started or ended, by `close` neither. `arm` is there for makes that
    hang on the arm's connectors. An arm switches `safe_off_outputs` off when the link to it or this program is lost;
    its flange reaches `reach` m from its base; `forward_of` is the cell's model of it, made from the table that its
    controller tells, or None: joints (6,) in rad to the flange's pose (6,) in m and rad.
    """

    clock: Clock
    look: bool = False
    arm: Arm | None = None
    safe_off_outputs: tuple[int, ...] = ()
    reach: float | None = None
    forward_of: Callable[[LinkTable | None], Callable[[Vector], Vector]] | None = None

    def require_arm(self) -> Arm:
        """The arm, for makes with `on_arm`."""
        assert self.arm is not None
        return self.arm

    def require_reach(self) -> float:
        """See the class; `ConfigError` where it was left out: no pose would be refused as too far."""
        if self.reach is None:
            raise ConfigError("an arm is connected with its reach in m: Surroundings(…, reach=1.3)")
        return self.reach


def serial_number(device: Device) -> str:
    """The serial number that the device itself tells."""
    return device.identity().serial


@dataclass(frozen=True, eq=False)
class Make(Generic[Record, Connected]):
    """One make of a kind of device, found by `driver = "NAME"` in the device's table.

    `record` is the table as a typed record; `connect(name, record, surroundings)` gives the device or raises a
    `CellError` that names it. `calibrated` are the record's keys that a calibration depends on;
    `calibrated_since` more of them, which count where they are not at their default, so that what was stored before
    there were such keys still fits. `identity` tells one device from another of the same make.
    `simulated(record, endpoint)` is the record with the address of the peer that `cell sim serve` has for it; None
    where it has none. `on_arm`: it hangs on the arm's connectors. `missing()` says what has to be installed before it
    can be connected, empty when nothing has. `replays`: what it delivers is of another day, so nothing may move by it.
    """

    kind: str
    name: str
    record: type[Record]
    connect: Callable[[str, Record, Surroundings], Connected]
    calibrated: frozenset[str] = frozenset()
    calibrated_since: frozenset[str] = frozenset()
    identity: Callable[[Connected], str] = serial_number
    simulated: Callable[[Record, Mapping[str, object]], Record] | None = None
    on_arm: bool = False
    missing: Callable[[], str] = lambda: ""
    replays: bool = False


AnyMake = Make[Any, Any]


def with_endpoint(*keys: str) -> Callable[[Record, Mapping[str, object]], Record]:
    """A make's `simulated`: the record with these keys as the peer has them."""

    def simulated(record: Record, endpoint: Mapping[str, object]) -> Record:
        return record.model_copy(update={key: endpoint[key] for key in keys})

    return simulated
