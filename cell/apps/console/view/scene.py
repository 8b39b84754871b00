"""The cell's bodies for drawing: the same boxes and capsules that the planner keeps apart, each in its own frame.

Made once for a configuration and a job. Whoever draws it turns the joints, shifts the carriage and places the station
as the readings say; nothing here moves. Lengths are in m, poses 16 numbers of a 4×4 matrix, row after row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.apps.console.view.meshes import LINKS, coarser, link_meshes
from cell.config.cell_config import CellConfig
from cell.config.job import Job, load_job
from cell.config.mounting import deck_plates, mounted
from cell.config.obstacles import station_obstacles, vehicle_obstacles
from cell.makes.records import CameraConfig
from cell.measure.inversion.nominal import read_mesh
from cell.measure.vision import parse_board
from cell.measure.vision.board.spec import centre_of
from cell.motion.arm_models import HOME, arm_kinematics
from cell.motion.bodies import Body, arm_bodies, station_bodies, tool_bodies, vehicle_bodies
from cell.procedures.arm.camera_poses import base_from_place_at_target
from drivers.link_table import LinkTable

ON_RAIL = "scan head"
"""The body that the rail moves; the planner keeps free all that it sweeps over."""
SIGHT_M = {"scan": 0.15, "target": 0.30}
"""How far the cameras' pyramids are drawn."""


def scene(
    config: CellConfig, job: str | Path | None = None, table: LinkTable | None = None, meshes: Path | None = None
) -> dict[str, Any]:
    """What stands and moves in the cell, as a JSON object (docs/reference/console.md); without a job neither part nor
    station.

    `table` is what the arm's controller told of its links, `meshes` a folder of pictures of them (`link_meshes`).
    Raises `ConfigError` for a job or a mesh that cannot be read.
    """
    shown = [] if meshes is None else link_meshes(meshes)
    pictured = {LINKS.index(mesh["on"]) for mesh in shown if mesh["on"] in LINKS}
    loaded, mesh = (None, None) if job is None else load_job(job)
    kinematics = arm_kinematics(config.arm.model, table)
    carried = mounted(config)
    grasp = None if loaded is None else loaded.grasp
    held, at = (None, None) if grasp is None else (grasp.size, grasp.flange_from_part.se3())
    swept = tool_bodies(held, at, carried)
    head = next(body for body in tool_bodies(None, None, replace(carried, travel=(0.0, 0.0))) if body.name == ON_RAIL)
    fixed = [*vehicle_bodies(deck_plates(config)), *vehicle_obstacles(config.obstacle)]
    placements = list(kinematics.model.jointPlacements)[1:]
    return {
        "arm": {
            "model": config.arm.model,
            "parent_from_joint": [numbers(placement) for placement in placements],
            "joint6_from_flange": numbers(kinematics.joint6_from_flange),
            "home": HOME.round(6).tolist(),
        },
        "bodies": [
            *(_body(body) for body in arm_bodies(config.arm.model) if body.parent not in pictured),
            *(_body(body) for body in (*swept, *fixed)),
        ],
        "meshes": shown,
        "rail": {
            "travel": list(carried.travel),
            "head": _body(head),
            "direction": carried.scan.rotation[:, 0].round(9).tolist(),
        },
        "cameras": {
            "scan": _camera(config.scan_camera, carried.scan, SIGHT_M["scan"]),
            "target": _camera(config.target_camera, carried.target, SIGHT_M["target"]),
        },
        "sheet": _sheet(config, loaded),
        "vehicle_from_base": numbers(config.arm.vehicle_from_base.se3()),
        "station": None if loaded is None or mesh is None else _station(config, loaded, mesh),
    }


def _station(config: CellConfig, job: Job, mesh: Path) -> dict[str, Any]:
    """What stands at the station, in the place frame, and where that is while nothing was measured yet."""
    vertices, triangles = coarser(*read_mesh(mesh, job.surface.mesh_unit))
    place_from_surface = job.surface.place_from_surface.se3()
    centre = pin.SE3(np.eye(3), centre_of(parse_board(job.board.spec)))
    bodies = station_bodies(
        pin.SE3.Identity(),
        job.place_from_board * centre,
        place_from_surface,
        (vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()),
    )
    return {
        "bodies": [_body(body) for body in (*bodies, *station_obstacles(job.obstacle, pin.SE3.Identity()))],
        "surface": {
            "place_from_surface": numbers(place_from_surface),
            "vertices": vertices.round(6).ravel().tolist(),
            "triangles": triangles.ravel().tolist(),
        },
        "surface_from_part": numbers(job.place.surface_from_part.se3()),
        "base_from_place": numbers(base_from_place_at_target(config, job)),
        "place_from_start": numbers(job.approach.start.se3()),
    }


def _sheet(config: CellConfig, job: Job | None) -> dict[str, Any]:
    """The laser's fan in the scan camera's frame: from the laser to both ends of the stripe, a bit below the work."""
    laser, camera = config.laser, config.scan_camera
    depth = 1.1 * (SIGHT_M["scan"] if job is None else job.scan.stand_off)
    half = depth * 0.5 * camera.height * camera.pixel / camera.focal_length
    x = -laser.baseline + depth / laser.tan_theta
    return {"corners": [-laser.baseline, 0.0, 0.0, x, -half, depth, x, half, depth]}


def _camera(camera: CameraConfig, flange_from_camera: pin.SE3, depth: float) -> dict[str, Any]:
    """Its mounting, and the half width and half height of what it sees at `depth` m."""
    half = 0.5 * depth * camera.pixel / camera.focal_length
    return {
        "flange_from_camera": numbers(flange_from_camera),
        "sight": [half * camera.width, half * camera.height, depth],
        "size": [camera.width, camera.height],
    }


def _body(body: Body) -> dict[str, Any]:
    """`parent` 0 is the base (the place frame at the station), 1 … 6 a joint, 7 the flange."""
    return {
        "name": body.name,
        "parent": body.parent,
        "placement": numbers(body.placement),
        "size": _rounded(body.size),
        "radius": body.radius,
    }


def numbers(pose: pin.SE3) -> list[float]:
    """The 16 numbers of its matrix, row after row."""
    return _rounded(pose.homogeneous.ravel())


def _rounded(values: Sequence[float] | NDArray[np.float64]) -> list[float]:
    return [float(v) for v in np.asarray(values).round(9)]
