"""The composition root: from configuration to devices. The only place that chooses a driver for a device."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass

from cell.config import CameraConfig, CellConfig
from cell.devices.gate import Gate
from cell.devices.gated import GatedArm, GatedClaw, GatedLaser, GatedRail, GatedVehicle
from cell.geometry.poses import to_ur
from cell.motion.kinematics import ArmKinematics
from drivers.arm.limits import ArmLimits
from drivers.arm.ur import UrArm
from drivers.camera.stream import StreamCamera
from drivers.clock import Clock
from drivers.interfaces import Arm, Camera, Claw, Device, Laser, Rail, Vehicle
from drivers.rail.tmcl import TmclRail
from drivers.switches import ArmSwitchedClaw, ArmSwitchedLaser
from drivers.vehicle.agilex import AgilexVehicle

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
    with ExitStack() as opened:
        arm = connect_arm(config, clock)
        opened.callback(arm.close)
        rail = connect_rail(config, clock)
        opened.callback(rail.close)
        vehicle = connect_vehicle(config, clock)
        opened.callback(vehicle.close)
        scan_camera = connect_camera("scan_camera", config.scan_camera, clock)
        opened.callback(scan_camera.close)
        target_camera = connect_camera("target_camera", config.target_camera, clock)
        opened.callback(target_camera.close)
        laser, claw = connect_switches(config, arm, clock)
        opened.pop_all()
    return behind_gate(clock, arm, rail, vehicle, scan_camera, target_camera, laser, claw)


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


def connect_arm(config: CellConfig, clock: Clock, control: bool = True) -> UrArm:
    """The arm; its own process switches the laser's output off when this one dies.

    Without `control` it is only looked at: a program that runs on it runs on.
    """
    kinematics = ArmKinematics()
    return UrArm(
        "arm",
        config.arm.address,
        clock=clock,
        limits=ArmLimits(
            joint_speeds=(config.arm.max_joint_speed,) * 6,
            joint_acceleration=config.arm.max_joint_acceleration,
            linear_speed=config.arm.max_tool_speed,
        ),
        payload=(config.arm.payload, config.arm.payload_centre),
        safe_off_outputs=(config.laser.output,),
        forward=lambda joints: to_ur(kinematics.fk(joints)),
        control=control,
    )


def connect_rail(config: CellConfig, clock: Clock) -> TmclRail:
    """The rail."""
    return TmclRail(
        "rail",
        config.rail.url,
        lead=config.rail.lead,
        steps_per_turn=config.rail.steps_per_turn,
        microsteps=config.rail.microsteps,
        travel=config.rail.travel,
        max_speed=config.rail.max_speed,
        acceleration=config.rail.acceleration,
        address=config.rail.address,
        motor=config.rail.motor,
        clock=clock,
    )


def connect_vehicle(config: CellConfig, clock: Clock) -> AgilexVehicle:
    """The vehicle."""
    return AgilexVehicle(
        "vehicle",
        config.vehicle.interface,
        config.vehicle.channel,
        bitrate=round(config.vehicle.bitrate),
        track=config.vehicle.track,
        max_speed=config.vehicle.max_speed,
        max_yaw_rate=config.vehicle.max_yaw_rate,
        clock=clock,
    )


def connect_camera(name: str, config: CameraConfig, clock: Clock) -> StreamCamera:
    """A camera, which must have the size that the configuration says."""
    return StreamCamera(name, config.address, shape=(config.height, config.width), clock=clock)


def connect_switches(config: CellConfig, arm: Arm, clock: Clock) -> tuple[Laser, Claw]:
    """Laser and claw, on the arm's digital outputs."""
    laser = ArmSwitchedLaser("laser", arm, config.laser.output)
    return laser, ArmSwitchedClaw("claw", arm, config.claw.output, config.claw.feedback, clock=clock)


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
