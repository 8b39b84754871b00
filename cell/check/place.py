"""Whether the way to the table and what stands on it make sense: the vehicle's poses, the place, the surface's mesh."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise, product
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from cell.config.cell_config import CellConfig
from cell.config.job import Job
from cell.measure.geometry.poses import from_parts, transform
from cell.measure.inversion.nominal import read_mesh
from cell.measure.vision import parse_board
from cell.measure.vision.board.spec import centre_of
from cell.motion.bodies import Body, station_bodies, vehicle_bodies
from cell.procedures.drive.approach import MAX_HEADING, Planar, wrap
from drivers.interfaces import Vector

Box = tuple[Vector, Vector]
"""Lowest and highest corner (3,), m."""

STEP = 0.05
ASIDE = 0.5
"""Farthest to the side of the target's line that the vehicle may begin, m."""
INTO_TABLE = 0.005
"""How much lower than the table's top something may be drawn, m."""
LEAST_COVERED = 0.1
"""Share of the swept area below which a surface is taken to be in the wrong unit or place."""
SCANNED_ACROSS = 0.02
"""Half the width of one sweep, m, roughly."""


def way_problems(job: Job, config: CellConfig) -> Iterator[str]:
    """What is wrong with the vehicle's poses: not on one floor, in the wrong order, or through the table.

    Of an arm on a fixed frame only the target counts.
    """
    plan = job.approach
    named = {"target": plan.target.se3()}
    if config.vehicle.DRIVES:
        named = {"start": plan.start.se3(), "staging": plan.staging.se3(), **named}
    heights = [pose.translation[2] for pose in named.values()]
    tilted = [name for name, pose in named.items() if pose.rotation[2, 2] < math.cos(math.radians(0.5))]
    if tilted:
        yield f"approach.{tilted[0]} is tilted; the vehicle stands upright, only the third angle may differ from 0 deg"
        return
    if max(heights) - min(heights) > 0.001 or not -2.0 <= heights[-1] <= 0.0:
        shown = ", ".join(f"{1e3 * z:g}" for z in heights)
        yield (
            f"approach: {', '.join(named)} at {shown} mm above the table's top; they need one height, the floor's "
            "(allowed: -2000 to 0 mm)"
        )
        return
    stands = {name: Planar.of(pose) for name, pose in named.items()}
    yield from _order_problems(stands)
    yield from _table_problems(stands, heights[-1], job, config)


def _order_problems(stands: dict[str, Planar]) -> Iterator[str]:
    """Staging lies between start and target, and the way there is about straight."""
    if len(stands) == 1:
        return
    start, staging, target = stands.values()
    ahead = [(target.inverse() * pose).x for pose in (start, staging)]
    if not ahead[0] <= ahead[1] + 1e-6 <= 2e-6:
        yield (
            f"approach: on the target's line start is at {1e3 * ahead[0]:.0f} mm, staging at {1e3 * ahead[1]:.0f} mm "
            "and target at 0 mm; staging has to lie between start and target"
        )
    for name, pose in (("start", start), ("staging", staging)):
        beside = target.inverse() * pose
        if abs(beside.y) > ASIDE or abs(wrap(beside.yaw)) > MAX_HEADING:
            yield (
                f"approach.{name} is {1e3 * beside.y:.0f} mm beside the target's line, turned by "
                f"{math.degrees(beside.yaw):.0f} deg (allowed: {1e3 * ASIDE:.0f} mm, "
                f"{math.degrees(MAX_HEADING):.0f} deg)"
            )


def _table_problems(stands: dict[str, Planar], height: float, job: Job, config: CellConfig) -> Iterator[str]:
    """The first place of the way where the deck comes too close to the table."""
    plan = job.approach
    deck, table = vehicle_bodies()[0], station_bodies(pin.SE3.Identity(), from_parts((0.0, 0.0, 0.1)))[0]
    base = config.arm.vehicle_from_base.se3()
    only = next(iter(stands.items()))
    ways = list(pairwise(stands.items())) or [(only, only)]
    for (before, first), (after, second) in ways:
        for share in np.linspace(0.0, 1.0, 2 + int(np.hypot(second.x - first.x, second.y - first.y) / STEP)):
            stand = _between(first, second, float(share), height)
            if (room := _distance(deck, stand * base, table, pin.SE3.Identity())) < plan.tolerance:
                x, y = (1e3 * v for v in stand.translation[:2])
                where = f"between {before} and {after}" if before != after else f"at {after}"
                yield (
                    f"approach: {where}, at ({x:.0f}, {y:.0f}) mm, the vehicle comes to "
                    f"{1e3 * max(0.0, room):.0f} mm of the table (allowed: at least approach.tolerance, "
                    f"{1e3 * plan.tolerance:g} mm)"
                )
                return


def place_problems(job: Job) -> Iterator[str]:
    """What of the board and the part would be inside the table."""
    centre = job.place_from_board * centre_of(parse_board(job.board.spec))
    if not 0.0 < centre[2] <= 2.0 or max(abs(centre[0]), abs(centre[1])) > 3.0:
        shown = ", ".join(f"{1e3 * v:.0f}" for v in centre)
        yield (
            f"board.place_from_board puts the board's middle at ({shown}) mm; it stands above the table's top and near "
            "it (allowed: -3000 to 3000 mm along and across, 0 to 2000 mm up)"
        )
    x, y, z = job.grasp.size
    part = job.surface.place_from_surface.se3() * job.place.surface_from_part.se3()
    corners = _corners(np.array([-x / 2, -y / 2, 0.0]), np.array([x / 2, y / 2, z]))
    yield from _above_table("place.surface_from_part and surface.place_from_surface put the part", part, corners)


def surface_problems(job: Job, extent: Box) -> Iterator[str]:
    """What is wrong with where the nominal surface lies: not on the table, or not where it is scanned."""
    low, high = extent
    on_place = job.surface.place_from_surface.se3()
    yield from _above_table("surface.place_from_surface puts the surface", on_place, _corners(low, high))
    half = 0.5 * job.scan.length
    for k, swath in enumerate(job.scan.swath):
        along = max(0.0, min(high[0], half) - max(low[0], -half))
        sides = swath.across - SCANNED_ACROSS, swath.across + SCANNED_ACROSS
        across = max(0.0, min(high[1], sides[1]) - max(low[1], sides[0]))
        if along * across < LEAST_COVERED * 4 * half * SCANNED_ACROSS:
            shown = " and ".join(f"{1e3 * a:.4g} to {1e3 * b:.4g}" for a, b in zip(low[:2], high[:2], strict=True))
            yield (
                f'surface.mesh "{job.surface.mesh}" lies at {shown} mm (x, y) with mesh_unit = '
                f'"{job.surface.mesh_unit}"; sweep {k + 1}, {1e3 * job.scan.length:g} mm long and '
                f"{1e3 * swath.across:g} mm across, sees too little of it: correct surface.mesh_unit, scan or the "
                "mesh's origin"
            )


def mesh_box(path: Path, unit: str) -> Box:
    """The box around a mesh in m. Raises `ConfigError` when it is no mesh, or of no sensible size."""
    vertices, _ = read_mesh(path, unit)
    return vertices.min(axis=0), vertices.max(axis=0)


def _above_table(what: str, place_from_body: pin.SE3, corners: Vector) -> Iterator[str]:
    table = station_bodies(pin.SE3.Identity(), from_parts((0.0, 0.0, 0.1)))[0]
    points = transform(place_from_body, corners)
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = table.placement.translation[:2], 0.5 * np.array(table.size[:2])
    if low[2] < -INTO_TABLE:
        yield f"{what} {-1e3 * low[2]:.0f} mm into the table (allowed: {1e3 * INTO_TABLE:g} mm below its top); raise it"
    if (low[:2] < middle - half).any() or (high[:2] > middle + half).any() or high[2] > 1.0:
        shown = ", ".join(f"{1e3 * v:.0f}" for v in 0.5 * (low + high))
        yield (
            f"{what} around ({shown}) mm, beside the table: its top reaches from ({1e3 * (middle - half)[0]:.0f}, "
            f"{1e3 * (middle - half)[1]:.0f}) to ({1e3 * (middle + half)[0]:.0f}, {1e3 * (middle + half)[1]:.0f}) mm"
        )


def _corners(low: Vector, high: Vector) -> Vector:
    return np.array(list(product(*zip(low, high, strict=True))))


def _between(first: Planar, second: Planar, share: float, height: float) -> pin.SE3:
    x, y = first.x + share * (second.x - first.x), first.y + share * (second.y - first.y)
    yaw = first.yaw + share * wrap(second.yaw - first.yaw)
    return from_parts((x, y, height), pin.rpy.rpyToMatrix(0.0, 0.0, yaw))


def _distance(first: Body, to_first: pin.SE3, second: Body, to_second: pin.SE3) -> float:
    shapes = []
    for body, pose in ((first, to_first), (second, to_second)):
        stand = pose * body.placement
        shapes += [coal.Box(*body.size), coal.Transform3s(stand.rotation, stand.translation)]
    return float(coal.distance(*shapes, coal.DistanceRequest(), coal.DistanceResult()))
