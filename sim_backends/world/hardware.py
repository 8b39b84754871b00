"""The devices of one scene: each model with the imperfections that the scene drew for it."""

from __future__ import annotations

import math

import numpy as np

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams
from sim_backends.models.arm_kinematics import TABLES
from sim_backends.models.camera import CameraSpec
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.models.ramp import Screw
from sim_backends.models.vehicle import VehicleModel, VehicleParams
from sim_backends.world.scene import Scene, stream

_TORQUE_PER_FORCE = 0.05
"""Noise of the measured torque, Nm, per newton of noise in the force."""


CAMERA_RATE = {"scan": 120.0, "target": 30.0}
"""Most pictures a second."""


def make_arm(scene: Scene, clock: WorldClock, made: type[ArmModel] = ArmModel) -> ArmModel:
    """The arm at rest, with its claw closed."""
    sigma, drawn = scene.deviations, scene.drawing.cell
    model = drawn.arm
    params = ArmParams.of(
        model,
        dh=TABLES[model] + scene.dh_factory,
        dh_error=scene.dh_error,
        repeatability=(sigma.arm_repeatability / math.sqrt(3.0), sigma.arm_repeatability_rotation),
        force_noise=(sigma.arm_force_noise, _TORQUE_PER_FORCE * sigma.arm_force_noise),
        memory=scene.effects.path_memory,
        harmonics=scene.workshop.harmonics,
        compliance=scene.effects.sag,
        carried=drawn.payload,
        carried_centre=drawn.payload_centre,
        serial=f"2023{scene.serial}",
    )
    arm = made(params, stream(scene.seed, "arm"), clock)
    if drawn.claw_output is not None:
        closed = 1 << drawn.claw_output
        arm.write_digital_outputs(closed, closed)
    return arm


def make_rail(scene: Scene, made: type[RailModel] = RailModel) -> RailModel:
    """The rail, switched on anywhere on its travel and not yet homed."""
    drawn = scene.drawing.cell.rail
    screw = Screw(
        lead=drawn.lead,
        scale_error=scene.rail_lead_error,
        periodic=scene.rail_periodic_amplitude,
        phase=scene.rail_periodic_phase,
        backlash=scene.rail_backlash,
    )
    params = RailParams(
        screw=screw,
        steps_per_turn=drawn.steps_per_turn,
        repeatability=scene.deviations.rail_homing,
        start=float(stream(scene.seed, "rail.start").uniform(*drawn.start)),
        serial=int(scene.serial),
        reversed=drawn.reversed,
    ).around(drawn.travel)
    return made(params, stream(scene.seed, "rail"))


def make_vehicle(scene: Scene, made: type[VehicleModel] = VehicleModel) -> VehicleModel:
    """The vehicle standing at its start, braked for good where it is a fixed frame.

    Its drift sideways and in yaw follow the odometry's errors.
    """
    start = scene.world_from_vehicle_start
    yaw = float(np.arctan2(start[1, 0], start[0, 0]))
    params = VehicleParams(
        start=(float(start[0, 3]), float(start[1, 3]), yaw),
        track=scene.drawing.cell.track,
        distance_scale=1.0 + scene.odometry_scale,
        yaw_scale=1.0 + scene.odometry_yaw,
        lateral_walk=0.1 * scene.deviations.odometry_scale,
        yaw_walk=0.1 * scene.deviations.odometry_yaw,
    )
    model = made(params, stream(scene.seed, "vehicle"))
    if scene.drawing.cell.fixed:
        model.set_brake(0.0, True)
    return model


def camera_spec(scene: Scene, camera: str) -> CameraSpec:
    """The camera "scan" or "target"; its serial carries the seed, so that another cell's calibration is recognised."""
    drawn, scan = scene.drawing.cell, camera == "scan"
    size = drawn.scan.size if scan else drawn.target.size
    timing = scene.scan_clock if scan else scene.target_clock
    return CameraSpec(
        model=f"SIM-{camera.upper()}",
        serial=f"SIM{scene.serial}-{camera.upper()}",
        width=size[0],
        height=size[1],
        frame_rate_max=CAMERA_RATE[camera],
        epoch=timing.epoch,
        drift_ppm=1e6 * timing.drift,
        latency=timing.latency,
    )
