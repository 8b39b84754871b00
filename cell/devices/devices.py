"""The devices of one cell together: those that are connected, their clock, their stop and their end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TypeVar

from cell.devices.gate.gate import Gate
from cell.devices.gate.gated import GatedRail
from cell.devices.gate.interlocks import Interlocks
from cell.devices.gate.laser import GatedLaser
from drivers.clock import Clock
from drivers.errors import NotConnectedError
from drivers.interfaces import Arm, Camera, Claw, Device, Vehicle
from statemachine.waiting import waiting_on

if TYPE_CHECKING:
    from cell.devices.simulated.following import DeviceFollowing

SAFE_STOP_TIMEOUT_S = 5.0


class Devices:
    """The devices of one cell, behind their gate (see `behind_gate`), and the clock that they share.

    A command connects only those that it needs: asking for another one is a `NotConnectedError`. `following` tells a
    simulated world what the real ones do; None where all are real, or all simulated.
    """

    following: DeviceFollowing | None = None

    def __init__(
        self,
        clock: Clock,
        gate: Gate,
        *,
        arm: Arm | None = None,
        rail: GatedRail | None = None,
        vehicle: Vehicle | None = None,
        scan_camera: Camera | None = None,
        target_camera: Camera | None = None,
        laser: GatedLaser | None = None,
        claw: Claw | None = None,
    ) -> None:
        self.clock = clock
        self.gate = gate
        self._arm = arm
        self._rail = rail
        self._vehicle = vehicle
        self._scan_camera = scan_camera
        self._target_camera = target_camera
        self._laser = laser
        self._claw = claw

    @property
    def interlocks(self) -> Interlocks:
        """What each command to them has to pass."""
        return self.gate.interlocks

    @property
    def arm(self) -> Arm:
        """The arm."""
        return _there("arm", self._arm)

    @property
    def rail(self) -> GatedRail:
        """The rail."""
        return _there("rail", self._rail)

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle."""
        return _there("vehicle", self._vehicle)

    @property
    def scan_camera(self) -> Camera:
        """The camera on the rail."""
        return _there("scan_camera", self._scan_camera)

    @property
    def target_camera(self) -> Camera:
        """The camera on the flange."""
        return _there("target_camera", self._target_camera)

    @property
    def laser(self) -> GatedLaser:
        """The laser."""
        return _there("laser", self._laser)

    @property
    def claw(self) -> Claw:
        """The claw."""
        return _there("claw", self._claw)

    def __contains__(self, name: object) -> bool:
        return getattr(self, f"_{name}", None) is not None

    def __iter__(self) -> Iterator[Device]:
        """Those that are connected, the arm last because laser and claw may hang on it."""
        everything: tuple[Device | None, ...] = (
            self._laser,
            self._claw,
            self._rail,
            self._vehicle,
            self._scan_camera,
            self._target_camera,
            self._arm,
        )
        return (device for device in everything if device is not None)

    def stop(self) -> list[str]:
        """Laser off, vehicle stopped and braked, rail and arm stopped; none waits for another to confirm it.

        Whoever works with the devices now cannot begin anything new with them. Returns what could not be confirmed, a
        line each; an empty list means that everything answered.
        """
        self.gate.shut()
        actions: dict[str, Callable[[], None]] = {}
        if self._laser is not None:
            actions["laser off"] = self._laser.stop
        if self._vehicle is not None:
            actions["vehicle stopped and braked"] = self._vehicle.brake
        if self._rail is not None:
            actions["rail stopped"] = self._rail.stop
        if self._arm is not None:
            actions["arm stopped"] = self._arm.stop
        return waiting_on(self.clock).each(actions, SAFE_STOP_TIMEOUT_S)

    def close(self) -> list[str]:
        """Close every device, the arm last because laser and claw hang on its outputs."""
        problems = []
        if self.following is not None:
            self.following.close()
        for device in self:
            try:
                device.close()
            except Exception as error:
                problems.append(f"{device.name} closed: {error}")
        return problems


Kind = TypeVar("Kind", bound=Device)


def _there(name: str, device: Kind | None) -> Kind:
    if device is None:
        raise NotConnectedError(name, "this command works without it and did not connect it. Open the whole cell")
    return device
