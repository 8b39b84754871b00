"""The devices of one scene: each model with the imperfections that the scene drew for it."""

from __future__ import annotations

import math

import numpy as np

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams
from sim_backends.models.arm_kinematics import TABLES
from sim_backends.models.camera import CameraSpec
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.models.screw import Screw
from sim_backends.models.vehicle import VehicleModel, VehicleParams
from sim_backends.world import nominal
from sim_backends.world.scene import Scene, stream

_TORQUE_PER_FORCE = 0.05
"""Noise of the measured torque, Nm, per newton of noise in the force."""


def make_arm(scene: Scene, clock: WorldClock, model: str = "UR10e") -> ArmModel:
    """The arm of the maker's `model` at rest, with its claw closed."""
    sigma = scene.deviations
    params = ArmParams.of(
        model,
        dh=TABLES[model] + scene.dh_factory,
        dh_error=scene.dh_error,
        repeatability=(sigma.arm_repeatability / math.sqrt(3.0), sigma.arm_repeatability_rotation),
        force_noise=(sigma.arm_force_noise, _TORQUE_PER_FORCE * sigma.arm_force_noise),
        memory=scene.effects.path_memory,
        harmonics=scene.workshop.harmonics,
        compliance=scene.effects.sag,
        serial=f"2023{scene.serial}",
    )
    arm = ArmModel(params, stream(scene.seed, "arm"), clock)
    closed = 1 << nominal.CLAW_OUTPUT
    arm.write_digital_outputs(closed, closed)
    return arm


def make_rail(scene: Scene, clock: WorldClock) -> RailModel:
    """The rail, switched on anywhere on its travel and not yet homed."""
    screw = Screw(
        scale_error=scene.rail_lead_error,
        periodic=scene.rail_periodic_amplitude,
        phase=scene.rail_periodic_phase,
        backlash=scene.rail_backlash,
    )
    start = float(stream(scene.seed, "rail.start").uniform(0.01, 0.09))
    params = RailParams(screw=screw, repeatability=scene.deviations.rail_homing, start=start, serial=int(scene.serial))
    return RailModel(params, stream(scene.seed, "rail"))


def make_vehicle(scene: Scene) -> VehicleModel:
    """The vehicle standing at its start; its drift sideways and in yaw follow the odometry's errors."""
    start = scene.world_from_vehicle_start
    yaw = float(np.arctan2(start[1, 0], start[0, 0]))
    params = VehicleParams(
        start=(float(start[0, 3]), float(start[1, 3]), yaw),
        distance_scale=1.0 + scene.odometry_scale,
        yaw_scale=1.0 + scene.odometry_yaw,
        lateral_walk=0.1 * scene.deviations.odometry_scale,
        yaw_walk=0.1 * scene.deviations.odometry_yaw,
    )
    return VehicleModel(params, stream(scene.seed, "vehicle"))


def camera_spec(scene: Scene, camera: str) -> CameraSpec:
    """The camera "scan" or "target"; its serial carries the seed, so that another cell's calibration is recognised."""
    scan = camera == "scan"
    size, rate = (nominal.SCAN_SIZE, nominal.SCAN_RATE) if scan else (nominal.TARGET_SIZE, nominal.TARGET_RATE)
    timing = scene.scan_clock if scan else scene.target_clock
    return CameraSpec(
        model=f"SIM-{camera.upper()}",
        serial=f"SIM{scene.serial}-{camera.upper()}",
        width=size[0],
        height=size[1],
        frame_rate_max=rate,
        epoch=timing.epoch,
        drift_ppm=1e6 * timing.drift,
        latency=timing.latency,
    )
