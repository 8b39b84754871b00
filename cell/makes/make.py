"""What a make is: everything that the cell has to know to work with one product behind one of its devices.

A package brings a make by an entry point of the group `assembly_cell.devices`, named KIND.NAME, that leads to a `Make`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from cell.makes.records import ArmConfig, CameraConfig, ClawConfig, DeviceConfig, LaserConfig, RailConfig, VehicleConfig
from drivers.clock import Clock
from drivers.interfaces import Arm, Device, Vector
from drivers.link_table import LinkTable

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
    `forward_of` is the cell's model of it, made from the table that its controller tells, or None: joints (6,) in rad
    to the flange's pose (6,) in m and rad.
    """

    clock: Clock
    look: bool = False
    arm: Arm | None = None
    safe_off_outputs: tuple[int, ...] = ()
    forward_of: Callable[[LinkTable | None], Callable[[Vector], Vector]] | None = None

    def require_arm(self) -> Arm:
        """The arm, for makes with `on_arm`."""
        assert self.arm is not None
        return self.arm


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
    simulated: Callable[[Record, Mapping[str, Any]], Record] | None = None
    on_arm: bool = False
    missing: Callable[[], str] = lambda: ""
    replays: bool = False


AnyMake = Make[Any, Any]
