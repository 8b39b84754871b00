"""The composition root: from configuration to devices, each of the make that the configuration names."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from cell.config import DEVICES, CellConfig
from cell.devices.built_in import ArmOutputLaserConfig
from cell.devices.gate import Gate
from cell.devices.gated import GatedArm, GatedClaw, GatedLaser, GatedRail, GatedVehicle
from cell.devices.make import Surroundings
from cell.geometry.poses import to_ur
from cell.motion.kinematics import ArmKinematics
from drivers.clock import Clock
from drivers.interfaces import Arm, Camera, Claw, Device, Laser, Rail, Vehicle

SAFE_STOP_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class Devices:
    """The devices of one cell, behind their gate (see `behind_gate`), and the clock that they share."""

    clock: Clock
    gate: Gate
    arm: Arm
    rail: Rail
    vehicle: Vehicle
    scan_camera: Camera
    target_camera: Camera
    laser: Laser
    claw: Claw

    def __iter__(self) -> Iterator[Device]:
        return iter((self.laser, self.claw, self.rail, self.vehicle, self.scan_camera, self.target_camera, self.arm))

    def stop(self) -> list[str]:
        """Laser off, vehicle stopped and braked, rail and arm stopped; all at once, none waits for another.

        Whoever works with the devices now cannot begin anything new with them. Returns what could not be confirmed, a
        line each; an empty list means that everything answered.
        """
        self.gate.shut()
        return _all_at_once(
            {
                "laser off": self.laser.stop,
                "vehicle stopped and braked": self._halt_vehicle,
                "rail stopped": self.rail.stop,
                "arm stopped": self.arm.stop,
            }
        )

    def _halt_vehicle(self) -> None:
        self.vehicle.brake()

    def close(self) -> list[str]:
        """Close every device, the arm last because laser and claw hang on its outputs."""
        problems = []
        for device in self:
            try:
                device.close()
            except Exception as error:
                problems.append(f"{device.name} closed: {error}")
        return problems


def connect(config: CellConfig) -> Devices:
    """Connect every device, behind a gate; when one fails, those connected are closed and the error goes on."""
    clock = Clock(config.cell.time_scale)
    made: dict[str, Any] = {}
    with ExitStack() as opened:
        for name in DEVICES:
            made[name] = connect_one(config, name, clock, arm=made.get("arm"))
            if not config.make(name).on_arm:
                opened.callback(made[name].close)
        opened.pop_all()
    return behind_gate(clock, **made)


def connect_one(config: CellConfig, name: str, clock: Clock, *, arm: Arm | None = None, look: bool = False) -> Any:
    """One device, not behind a gate; what hangs on the arm is given the `arm`.

    With `look` it is only looked at: nothing on it is set, started or ended, and what runs on it runs on.
    """
    around = Surroundings(clock, look, arm)
    if DEVICES[name] == "arm":
        # Its own process switches the laser off when this one dies.
        kinematics = ArmKinematics()
        around = Surroundings(clock, look, None, safe_off_outputs(config), lambda joints: to_ur(kinematics.fk(joints)))
    return config.make(name).connect(name, config.device(name), around)


def safe_off_outputs(config: CellConfig) -> tuple[int, ...]:
    """The arm's outputs that have to go off when nobody watches them any more: the laser's, if it hangs on one."""
    return (config.laser.output,) if isinstance(config.laser, ArmOutputLaserConfig) else ()


def behind_gate(
    clock: Clock,
    arm: Arm,
    rail: Rail,
    vehicle: Vehicle,
    scan_camera: Camera,
    target_camera: Camera,
    laser: Laser,
    claw: Claw,
) -> Devices:
    """These devices, of whatever make, with everything that moves, shines or grips behind one gate."""
    gate = Gate()
    return Devices(
        clock,
        gate,
        GatedArm(arm, gate),
        GatedRail(rail, gate),
        GatedVehicle(vehicle, gate),
        scan_camera,
        target_camera,
        GatedLaser(laser, gate),
        GatedClaw(claw, gate),
    )


def _all_at_once(actions: dict[str, Callable[[], None]]) -> list[str]:
    problems: list[str] = []

    def run(what: str, action: Callable[[], None]) -> None:
        # Whatever ends the thread: what it was to confirm is not confirmed.
        try:
            action()
        except BaseException as error:
            problems.append(f"{what}: not confirmed, {error}")

    threads = {
        what: threading.Thread(target=run, args=(what, action), name=f"safe stop: {what}", daemon=True)
        for what, action in actions.items()
    }
    for thread in threads.values():
        thread.start()
    deadline = time.monotonic() + SAFE_STOP_TIMEOUT_S
    for what, thread in threads.items():
        thread.join(max(0.0, deadline - time.monotonic()))
        if thread.is_alive():
            problems.append(f"{what}: not confirmed within {SAFE_STOP_TIMEOUT_S:.0f} s")
    return problems
