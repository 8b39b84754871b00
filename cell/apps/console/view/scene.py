"""The cell's bodies for drawing: the same boxes and capsules that the planner keeps apart, each in its own frame.

Made once for a configuration and a job. Whoever draws it turns the joints, shifts the carriage and places the station
as the readings say. A folder of meshes may stand in place of the arm's capsules, for the eye only. `SceneNow` tells
what a run has found of the place, the part and the arm's way. Lengths are in m, poses 16 numbers of a 4×4 matrix, row
after row.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.base.toml_file import below
from cell.config.cell_config import CellConfig, deck_plates, mounted, station_obstacles, vehicle_obstacles
from cell.config.job import Job, load_job
from cell.devices.gate.interlocks import Situation
from cell.measure.inversion.nominal import read_mesh
from cell.measure.vision.board.view import centre_of, parse_board
from cell.motion.collision import PLACED, Body, arm_bodies, station_bodies, tool_bodies, vehicle_bodies
from cell.motion.kinematics import HOME, arm_kinematics
from cell.procedures.arm.photograph import base_from_place_at_target
from drivers.errors import ConfigError
from drivers.interfaces import LinkTable, Vector
from drivers.make import CameraConfig

LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
"""Fixed to the base, then to what each joint turns."""
NAMES = (*LINKS, "flange", "vehicle")
KINDS = (".stl", ".ply", ".obj")
MOST_TRIANGLES = 8_000
SMALLEST_M, LARGEST_M = 0.005, 5.0


def link_meshes(folder: Path) -> list[dict[str, object]]:
    """The files of `folder` as JSON objects: `on`, one of `NAMES`, flat `vertices` in m and `triangles`.

    Raises `ConfigError` for a folder that is not there, a file of another name, two of one name, and one that is no
    mesh in metres.
    """
    try:
        files = sorted(path for path in folder.iterdir() if below(folder, path.name) and not path.name.startswith("."))
    except OSError as error:
        unread = f"cell.meshes: the folder {folder} cannot be read ({error.strerror}); create it or remove the line"
        raise ConfigError(unread) from error
    names = f"the names are {', '.join(NAMES)} with {', '.join(KINDS)}"
    found: dict[str, Path] = {}
    for path in files:
        if path.suffix.lower() not in KINDS:
            continue
        if path.stem not in NAMES:
            raise ConfigError(f"cell.meshes: {path} belongs to no link; {names}")
        if path.stem in found:
            both = f"{path.name} and {found[path.stem].name} in {folder}"
            raise ConfigError(f"cell.meshes: {both} are the same link; keep one")
        found[path.stem] = path
    if not found:
        raise ConfigError(f"cell.meshes: {folder} holds no mesh; {names}")
    return [_drawn(name, path) for name, path in found.items()]


def _drawn(name: str, path: Path) -> dict[str, object]:
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=True)
        vertices, triangles = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    except Exception as error:  # every reader of trimesh raises its own
        raise ConfigError(f"cell.meshes: {path} cannot be read as a mesh; export it as STL, PLY or OBJ") from error
    if vertices.ndim != 2 or not len(triangles) or not np.isfinite(vertices).all():
        raise ConfigError(
            f"cell.meshes: {path} holds {len(triangles)} triangles, or corners that are not numbers; export it again"
        )
    size = float(np.ptp(vertices, axis=0).max())
    if not SMALLEST_M <= size <= LARGEST_M:
        raise ConfigError(
            f"cell.meshes: {path} measures {size:.3g} m (allowed: {SMALLEST_M:g} to {LARGEST_M:g} m); export it in "
            "metres"
        )
    points, faces = coarser(vertices, triangles)
    return {"on": name, "vertices": points.round(5).ravel().tolist(), "triangles": faces.ravel().tolist()}


def coarser(
    vertices: NDArray[np.float64], triangles: NDArray[np.int64], most: int = MOST_TRIANGLES
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The mesh of vertices (n, 3) m and triangles (m, 3), or one of at most `most`: one vertex for all in a cube."""
    edge = float(np.ptp(vertices, axis=0).max()) / 512
    points, faces = vertices, triangles
    while len(faces) > most:
        cubes = np.floor((vertices - vertices.min(axis=0)) / edge).astype(np.int64)
        _, owner = np.unique(cubes @ np.array([1, 1 << 20, 1 << 40]), return_inverse=True)
        count = np.bincount(owner)
        points = np.column_stack([np.bincount(owner, weights=vertices[:, axis]) / count for axis in range(3)])
        faces = owner[triangles]
        apart = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces, edge = faces[apart], 1.5 * edge
    return points, faces


ON_RAIL = "scan head"
"""The body that the rail moves; the planner keeps free all that it sweeps over."""
SIGHT_M = {"scan": 0.15, "target": 0.30}
"""How far the cameras' pyramids are drawn."""


def scene(
    config: CellConfig, job: str | Path | None = None, table: LinkTable | None = None, meshes: Path | None = None
) -> dict[str, object]:
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
            "direction": _rounded(carried.scan.rotation[:, 0]),
        },
        "cameras": {
            "scan": _camera(config.scan_camera, carried.scan, SIGHT_M["scan"]),
            "target": _camera(config.target_camera, carried.target, SIGHT_M["target"]),
        },
        "sheet": _sheet(config, loaded),
        "vehicle_from_base": numbers(config.arm.vehicle_from_base.se3()),
        "station": None if loaded is None or mesh is None else _station(config, loaded, mesh),
    }


def _station(config: CellConfig, job: Job, mesh: Path) -> dict[str, object]:
    """What stands at the station, in the place frame, and where that is while nothing was measured yet."""
    vertices, triangles = coarser(*read_mesh(mesh, job.surface.mesh_unit))
    place_from_surface = job.surface.place_from_surface.se3()
    centre = pin.SE3(np.eye(3), centre_of(parse_board(job.board.spec)))
    box = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
    bodies = station_bodies(pin.SE3.Identity(), job.place_from_board * centre, place_from_surface, box)
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


def _sheet(config: CellConfig, job: Job | None) -> dict[str, object]:
    """The laser's fan in the scan camera's frame: from the laser to both ends of the stripe, a bit below the work."""
    laser, camera = config.laser, config.scan_camera
    depth = 1.1 * (SIGHT_M["scan"] if job is None else job.scan.stand_off)
    half = depth * 0.5 * camera.height * camera.pixel / camera.focal_length
    x = -laser.baseline + depth / laser.tan_theta
    return {"corners": [-laser.baseline, 0.0, 0.0, x, -half, depth, x, half, depth]}


def _camera(camera: CameraConfig, flange_from_camera: pin.SE3, depth: float) -> dict[str, object]:
    """Its mounting, and the half width and half height of what it sees at `depth` m."""
    half = 0.5 * depth * camera.pixel / camera.focal_length
    sight = [half * camera.width, half * camera.height, depth]
    return {"flange_from_camera": numbers(flange_from_camera), "sight": sight, "size": [camera.width, camera.height]}


def _body(body: Body) -> dict[str, object]:
    """`parent` 0 is the base (the place frame at the station), 1 … 6 a joint, 7 the flange."""
    placed = {"placement": numbers(body.placement), "size": _rounded(body.size)}
    return {"name": body.name, "parent": body.parent, **placed, "radius": body.radius}


def numbers(pose: pin.SE3) -> list[float]:
    """The 16 numbers of its matrix, row after row."""
    return _rounded(pose.homogeneous.ravel())


def _rounded(values: Sequence[float] | NDArray[np.float64]) -> list[float]:
    return [float(v) for v in np.asarray(values).round(9)]


MOST_POINTS = 80


class SceneNow:
    """Reads a cell's interlocks, which planner and steps tell; called by one thread, keeps nobody waiting."""

    def __init__(self) -> None:
        self._way: Vector | None = None
        self._path: dict[str, object] | None = None
        self._count = 0
        # The same table that the planner is given, at the place's own frame.
        self._table = station_bodies(pin.SE3.Identity(), pin.SE3.Identity())[0]

    def as_dict(self, situation: Situation) -> dict[str, object]:
        """`place` (base_from_place) once the board was measured, `part` (base_from_part) once it was let go, each 16
        numbers or None, and `path`, the flange's points (m) on the way that the arm follows now, or None."""
        told = {body.name: body for body in situation.station}
        table = told.get(self._table.name)
        place = None if table is None else numbers(table.placement * self._table.placement.inverse())
        return {"place": place, "part": _part(told.get(PLACED)), "path": self._followed(situation)}

    def _followed(self, situation: Situation) -> dict[str, object] | None:
        way, motion = situation.way, situation.last
        if way is None or motion is None or motion.done:
            return None
        if way is not self._way:
            self._way, self._count = way, self._count + 1
            chosen = np.linspace(0, len(way) - 1, min(len(way), MOST_POINTS)).round().astype(int)
            points = [situation.forward(joints).translation.round(4).tolist() for joints in way[chosen]]
            self._path = {"n": self._count, "points": points}
        return self._path


def _part(placed: Body | None) -> list[float] | None:
    """The part's frame lies in its mating face, half its height below the body's middle."""
    if placed is None:
        return None
    return numbers(placed.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.5 * placed.size[2]])))
