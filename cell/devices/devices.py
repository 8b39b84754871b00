"""The devices of one cell together: those that are connected, their clock, their stop, their health and their end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from cell.devices.gate.gate import Gate
from cell.devices.gate.gated import GatedCamera, GatedLaser, GatedRail
from cell.devices.gate.interlocks import Interlocks
from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceError, DeviceFault, NotConnectedError
from drivers.interfaces import Arm, ArmSafety, Claw, Device, Vehicle
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
        self, clock: Clock, gate: Gate, *, arm: Arm | None = None, rail: GatedRail | None = None,
        vehicle: Vehicle | None = None, scan_camera: GatedCamera | None = None,
        target_camera: GatedCamera | None = None, laser: GatedLaser | None = None, claw: Claw | None = None,
    ) -> None:  # fmt: skip
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
    def scan_camera(self) -> GatedCamera:
        """The camera on the rail."""
        return _there("scan_camera", self._scan_camera)

    @property
    def target_camera(self) -> GatedCamera:
        """The camera on the flange."""
        return _there("target_camera", self._target_camera)

    @property
    def bright(self) -> bool:
        """Whether ambient light has whitened a picture since `forget_ambient_light`."""
        return any(camera.longest_exposure < math.inf for camera in self._cameras)

    def forget_ambient_light(self) -> None:
        """Forget how bright it was: the cameras expose as long as they are asked to."""
        for camera in self._cameras:
            camera.longest_exposure = math.inf

    @property
    def _cameras(self) -> list[GatedCamera]:
        return [camera for camera in (self._scan_camera, self._target_camera) if camera is not None]

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
        order = ("laser", "claw", "rail", "vehicle", "scan_camera", "target_camera", "arm")
        return (getattr(self, f"_{name}") for name in order if name in self)

    def stop(self) -> list[str]:
        """Laser and outputs that are tried off, vehicle braked, rail and arm stopped; none waits for another.

        Whoever works with the devices now cannot begin anything new with them. Returns what could not be confirmed, a
        line each; an empty list means that everything answered.
        """
        self.gate.shut()
        actions: dict[str, Callable[[], None]] = {}
        if self._laser is not None:
            actions["laser off"] = self._laser.stop
        # On a virtual clock one comes after another: outputs go off at once, and the arm is the one that may touch.
        if self._arm is not None:
            for output in self.interlocks.tried_outputs:
                actions[f"output {output} off"] = partial(self._arm.set_digital_output, output, False)
            actions["arm stopped"] = self._arm.stop
        if self._vehicle is not None:
            actions["vehicle stopped and braked"] = self._vehicle.brake
        if self._rail is not None:
            actions["rail stopped"] = self._rail.stop
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


def stop_cell(devices: Devices) -> None:
    """Bring every device to rest; raises `DeviceFault` that lists what could not be confirmed."""
    if problems := devices.stop():
        raise stop_not_confirmed("; ".join(problems))


def stop_not_confirmed(message: str) -> DeviceFault:
    """The fault of a cell of which it is not known that it stands."""
    return DeviceFault("cell", "safe_stop", message, recoverable=False, hint="Look at the cell before going near it.")


def require_healthy(devices: Devices) -> None:
    """Raise when a safety system has stopped the arm, or the vehicle has a fault, whichever device is waited for.

    An emergency stop is told before anything else: a person may be asked about the other fault meanwhile. A reading
    that is too old says nothing here: the next command to that device finds a silent link.
    """
    require_no_emergency_stop(devices)
    _require_arm(devices)
    if "vehicle" in devices:
        with suppress(DeadlineError):
            devices.vehicle.check()


def require_no_emergency_stop(devices: Devices) -> None:
    """Raise when an emergency stop is pressed. For jogs, whose work may be to clear any other fault."""
    _require_arm(devices, ArmSafety.EMERGENCY_STOP)
    if "vehicle" not in devices:
        return
    try:
        pressed = devices.vehicle.state().emergency_stop
    except DeviceError:
        return
    if pressed:
        devices.vehicle.check()


def _require_arm(devices: Devices, *unfit: ArmSafety) -> None:
    """Raise when the arm's safety system has stopped it; with `unfit` only in these states."""
    if "arm" not in devices:
        return
    try:
        state = devices.arm.state()
        safety = state.safety
    except DeviceError as error:
        # A late state, or a link that `recover` has closed and opens again: the next command finds what is wrong.
        if isinstance(error, DeadlineError) or getattr(error, "code", "") == "arm.link_closed":
            return
        raise
    if safety in unfit if unfit else safety is not ArmSafety.NORMAL:
        raise DeviceFault(
            "arm", f"arm.{safety.name.lower()}",
            ": ".join(filter(None, (f"the arm is in {safety.value}", state.reason))),
            recoverable=safety is ArmSafety.PROTECTIVE_STOP, hint="Look for the reason and clear the way.",
        )  # fmt: skip
