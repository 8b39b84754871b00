"""The names of all faults that a simulated cell can be made to have; what each does is with its model or peer."""

from __future__ import annotations

from sim_backends.peers.arm.rtde.server import FAULTS as CONTROLLER_FAULTS
from sim_backends.peers.camera.frames import FAULTS as CAMERA_FAULTS
from sim_backends.peers.rail.tmcl import FAULTS as RAIL_FAULTS
from sim_backends.peers.vehicle.agilex import FAULTS as VEHICLE_FAULTS

__all__ = [
    "ARM_FAULTS", "CAMERA_FAULTS", "CONTROLLER_FAULTS", "FAULT_NAMES", "RAIL_FAULTS", "TARGET_CAMERA_FAULTS",
    "VEHICLE_FAULTS",
]  # fmt: skip

ARM_FAULTS = ("arm.protective_stop", "arm.safeguard_stop", "arm.emergency_stop", "arm.local_control")
TARGET_CAMERA_FAULTS = tuple(f"target_{name}" for name in CAMERA_FAULTS)
"""Those of the target camera; a name that says only `camera.` is the scan camera's."""

FAULT_NAMES = (*ARM_FAULTS, *CONTROLLER_FAULTS, *RAIL_FAULTS, *VEHICLE_FAULTS, *CAMERA_FAULTS, *TARGET_CAMERA_FAULTS)
