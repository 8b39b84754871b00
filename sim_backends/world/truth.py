"""The world's truth as one JSON object, for the report's comparison and for nothing that the cell does.

Lengths in m, angles in rad, poses as nested 4×4 lists named `a_from_b`; frames as in `nominal`.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from sim_backends.world.levels import assumed_noise
from sim_backends.world.nominal import inverse
from sim_backends.world.scene import CameraClock, Lens
from sim_backends.world.world import Pose, World


def truth(world: World) -> dict[str, Any]:
    """Everything true about `world` now; see the keys."""
    t = world.clock.now()
    scene = world.scene
    vehicle = world.vehicle.feedback(t)
    shape = world.station.ground
    outputs = world.arm.digital_outputs
    return {
        "seed": scene.seed,
        "level": scene.level,
        "speed": world.clock.speed,
        "time": t,
        "assumed_noise": assumed_noise(scene.level),
        "surface": {"name": shape.name, "half_x": shape.half_x, "half_y": shape.half_y, "unit": "m"},
        "poses": {name: _nested(pose) for name, pose in _poses(world, t).items()},
        "scan_lens": _lens(world.lens("scan", t)),
        "target_lens": _lens(world.lens("target", t)),
        "light_plane": world.light_plane(t),
        "rail": {
            "direction": _nested(scene.rail_direction),
            "scale": 1.0 + scene.rail_lead_error,
            "backlash": scene.rail_backlash,
            "periodic": scene.rail_periodic_amplitude,
            "carriage": world.rail.carriage(t),
        },
        "scan_clock": _timing(scene.scan_clock),
        "target_clock": _timing(scene.target_clock),
        "part": {"held": world.part.held},
        "laser_on": world.switched("laser"),
        "digital_outputs": [bool(outputs >> i & 1) for i in range(8)],
        "vehicle": {
            "stopped": vehicle.speed == 0.0 and vehicle.yaw_rate == 0.0,
            "braked": vehicle.braked,
            "speed": vehicle.speed,
            "yaw_rate": vehicle.yaw_rate,
        },
        "arm": {
            "moving": world.arm.moving,
            "safety": world.arm.safety.name.lower(),
            "fault": world.arm.fault_text,
        },
        "collisions": [asdict(collision) for collision in world.collisions.found],
        "rail_moving": world.rail.velocity(t) != 0,
    }


def _poses(world: World, t: float) -> dict[str, Pose]:
    """Every pose (4, 4), m, by its name."""
    scene = world.scene
    world_from_base = world.world_from_base(t)
    base_from_world = inverse(world_from_base)
    base_from_flange = world.arm.base_from_flange(t)
    world_from_part = world.part.part_pose(world_from_base @ base_from_flange)
    return {
        "world_from_vehicle": world.vehicle.world_from_vehicle(t),
        "world_from_base": world_from_base,
        "world_from_surface": scene.world_from_surface,
        "world_from_board": scene.world_from_board,
        "base_from_surface": base_from_world @ scene.world_from_surface,
        "base_from_board": base_from_world @ scene.world_from_board,
        "base_from_flange": base_from_flange,
        "base_from_fine_board": scene.base_from_fine_board,
        "base_from_deck_board": scene.base_from_deck_board,
        "flange_from_scan_camera": scene.flange_from_scan_camera,
        "flange_from_target_camera": scene.flange_from_target_camera,
        "flange_from_part": scene.flange_from_part,
        "base_from_part": base_from_world @ world_from_part,
        "surface_from_part": inverse(scene.world_from_surface) @ world_from_part,
    }


def _nested(values: Pose) -> Any:
    return np.asarray(values).tolist()


def _lens(lens: Lens) -> dict[str, Any]:
    return {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy, "dist": list(lens.dist)}


def _timing(clock: CameraClock) -> dict[str, float]:
    return {"drift": clock.drift, "latency": clock.latency}
