"""Whether the vehicle's way to the table makes sense, the place and its mesh, and how the part is put down there."""

import math
from collections.abc import Iterator
from itertools import pairwise, product
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from cell.config.cell_config import CellConfig
from cell.config.job import Job, PartSection
from cell.measure.geometry.poses import from_parts, transform
from cell.measure.inversion.mating import APART, NEXT_STEP, MatingGap, drawn_gap
from cell.measure.inversion.nominal import NominalSurface, read_mesh
from cell.measure.vision.board.view import centre_of, parse_board
from cell.motion.collision import Body, station_bodies, vehicle_bodies
from cell.procedures.drive.driving import MAX_HEADING, Planar, wrap
from cell.procedures.steps import verify
from cell.procedures.steps.kinds import kind_of
from drivers.interfaces import Vector
from drivers.make import MOST_PAYLOAD

G = 9.81
REACTION_S = 0.05
"""From the touch until the arm stands: state packet, two set points, servoJ's look-ahead and the stop."""
LEAST_OVER = 0.5
"""Share of the part's footprint that lies over the surface, at least."""
GRID = 21
"""Rays to the side over the footprint."""
FAR_M = 1.0
BESIDE_PART_M = 2e-3
"""A pin or a hole's rim may stand out of the mesh of a part so far."""
OUT_OF_BOX_M = 0.5e-3
"""A part's mesh may go so far beyond its box, m, without a word."""


def contact_problems(job: Job, config: CellConfig, mesh: Path) -> Iterator[str]:
    """What of `place`, `grasp` and `scan.exposure` cannot end well, each with its value and what is allowed."""
    place, grasp, arm = job.place, job.grasp, config.arm
    left = G * (MOST_PAYLOAD[arm.model] - arm.payload) if arm.model in MOST_PAYLOAD else np.inf
    if place.contact_force > left:
        yield (
            f"place.contact_force {place.contact_force:g} N is more than a {arm.model} may carry beside arm.payload, "
            f"{arm.payload:g} kg (allowed: 2 to {left:.0f} N)"
        )
    fastest = place.tolerance / REACTION_S
    if place.contact_speed > fastest:
        yield (
            f"place.contact_speed {1e3 * place.contact_speed:g} mm/s: after the touch the arm goes on by "
            f"{1e3 * place.contact_speed * REACTION_S:.2g} mm, more than place.tolerance (allowed: at most "
            f"{1e3 * fastest:.3g} mm/s)"
        )
    scatter = np.hypot(grasp.sigma, np.sqrt(2) * arm.repeatability)
    turning = np.hypot(grasp.sigma_angle, np.sqrt(2) * arm.repeatability_angle)
    for key, least, asked, unit in (
        ("tolerance", scatter, place.tolerance, "mm"),
        ("tolerance_angle", turning, place.tolerance_angle, "mrad"),
    ):
        if least > asked:
            sigma = "grasp.sigma" if unit == "mm" else "grasp.sigma_angle"
            yield (
                f"place.{key} {1e3 * asked:g} {unit} cannot be kept: {sigma} and the arm's repeatability alone leave "
                f"{1e3 * least:.3g} {unit} open, one standard deviation (allowed: more than that)"
            )
    for key, holds in (("grasp", grasp), ("nest", job.nest if job.unloads else None)):
        if holds is not None and place.contact_travel < 3 * holds.sigma:
            yield (
                f"place.contact_travel {1e3 * place.contact_travel:g} mm is less than three times {key}.sigma: the "
                f"part would often not touch within it (allowed: at least {3e3 * holds.sigma:g} mm)"
            )
    if (blur := job.scan.exposure * job.scan.speed) > 0.5 * place.tolerance:
        yield (
            f"scan.exposure {1e3 * job.scan.exposure:g} ms at scan.speed {1e3 * job.scan.speed:g} mm/s smears a line "
            f"by {1e3 * blur:.3g} mm (allowed: half of place.tolerance, {500 * place.tolerance:g} mm)"
        )
    yield from _height_problems(job, *under_part(job, mesh))


def _height_problems(job: Job, over: float, highest: float) -> Iterator[str]:
    height = job.grasp.size[2]
    if over < LEAST_OVER:
        yield (
            f"place.surface_from_part: {100 * over:.0f} % of the part's footprint lie over the surface (allowed: at "
            f"least {100 * LEAST_OVER:.0f} %); correct the pose, grasp.size or the mesh's origin"
        )
    elif highest < -job.place.contact_travel:
        yield (
            f"place.surface_from_part: the surface lies {-1e3 * highest:.3g} mm below the part's lowest plane, beyond "
            f"place.contact_travel, {1e3 * job.place.contact_travel:g} mm: the part would be let go of in the air. "
            "Lower it"
        )
    elif highest > height:
        yield (
            f"place.surface_from_part: the surface goes through the whole part, {1e3 * highest:.3g} mm into its box of "
            f"{1e3 * height:g} mm (grasp.size). Raise it"
        )


def mating_problems(job: Job, mesh: Path) -> Iterator[str]:
    """Whether the part as drawn lies on the surface as drawn; nothing without a mesh of the part."""
    if job.part is None:
        return
    found = _drawn(job, mesh)
    if problem := f"{APART}. {NEXT_STEP}" if found is None else found.problem(job.place.tolerance):
        yield f'part.mesh "{Path(job.part.mesh).name}": {problem}'
    yield from _feature_problems(job, job.part)


def _feature_problems(job: Job, part: PartSection) -> Iterator[str]:
    """Features lie on the part, and somebody looks at it."""
    if part.feature and verify.STEP.name not in kind_of(job).names:
        yield (
            f"part.feature {part.feature[0].name}: nobody looks at the placed part. Write place.verify, a kind of job "
            "with the step verify, or no feature"
        )
    low, high = NominalSurface.load(Path(part.mesh), unit=part.mesh_unit).extent
    for feature in part.feature:
        at = np.array(feature.at)
        if (off := float(np.linalg.norm(at - np.clip(at, low, high)))) > BESIDE_PART_M:
            yield (
                f"part.feature {feature.name}: at lies {1e3 * off:.1f} mm beside the box of the part's mesh (allowed: "
                f"at most {1e3 * BESIDE_PART_M:g} mm). Give it in the part's own frame"
            )


def _drawn(job: Job, mesh: Path) -> MatingGap | None:
    assert job.part is not None
    nominal = NominalSurface.load(mesh, unit=job.surface.mesh_unit)
    part = NominalSurface.load(Path(job.part.mesh), unit=job.part.mesh_unit)
    return drawn_gap(nominal, job.place.surface_from_part.se3(), part)


def contact_notes(job: Job, mesh: Path) -> Iterator[str]:
    """What a person should know of the place before the first part."""
    over, highest = under_part(job, mesh)
    yield (
        f"at the place the surface reaches {1e3 * highest:.1f} mm into the part's box of "
        f"{1e3 * job.grasp.size[2]:g} mm, and {100 * over:.0f} % of its footprint lie over the surface"
    )
    if job.part is None:
        yield (
            "the job has no mesh of its part ([part]): whether its underside fits the surface, and how it lies once it "
            "was placed, is not looked at"
        )
        return
    low, high = NominalSurface.load(Path(job.part.mesh), unit=job.part.mesh_unit).extent
    x, y, z = job.grasp.size
    beyond = float(np.max([high - (x / 2, y / 2, z), (-x / 2, -y / 2, 0.0) - low]))
    if beyond > OUT_OF_BOX_M:
        yield (
            f"the part's mesh goes {1e3 * beyond:.1f} mm beyond its box, grasp.size: the arm keeps only that box clear"
        )
    if (found := _drawn(job, mesh)) is not None:
        yield f"the part's mating face, as drawn: {found.words}"
    if verify.STEP.name not in kind_of(job).names:
        yield "nobody looks how the part lies once it was placed: place.verify says so, or job.kind has no such step"


def under_part(job: Job, mesh: Path) -> tuple[float, float]:
    """Share of the part's footprint over the nominal surface, and how far the surface rises there above the part's
    lowest plane, m; (0, -inf) where nothing is under it. The part is its box `grasp.size`, upwards from its origin."""
    import trimesh  # takes long to load, which only this check needs

    vertices, triangles = read_mesh(mesh, job.surface.mesh_unit)
    pose = job.place.surface_from_part.se3()
    body = trimesh.Trimesh((vertices - pose.translation) @ pose.rotation, triangles, process=False)
    # A little off the edges, which a ray may miss.
    across, along = (0.999 * np.linspace(-0.5, 0.5, GRID) * side for side in job.grasp.size[:2])
    starts = np.array([(x, y, FAR_M) for x in across for y in along])
    hits, rays, _ = body.ray.intersects_location(starts, np.tile([0.0, 0.0, -1.0], (len(starts), 1)))
    if not len(hits):
        return 0.0, -np.inf
    return len(np.unique(rays)) / len(starts), float(hits[:, 2].max())


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
    """What is wrong with the vehicle's poses: not on one floor, in the wrong order, or through the table. Of an arm on
    a fixed frame only the target counts."""
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


def surface_problems(job: Job, extent: Box, mesh: Path) -> Iterator[str]:
    """What is wrong with where the nominal surface lies: not on the table, upside down, or not where it is scanned."""
    low, high = extent
    vertices, triangles = read_mesh(mesh, job.surface.mesh_unit)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    up = np.cross(b - a, c - a) @ job.place.surface_from_part.se3().rotation[:, 2]
    # As much of a solid faces up as down; what of it is seen is not known here.
    if up.sum() < -0.5 * np.abs(up).sum():
        yield (
            f'surface.mesh "{job.surface.mesh}": its triangles face away from the part that is placed onto it; '
            "`cell new-job --flip yes` turns them, or correct place.surface_from_part"
        )
    on_place = job.surface.place_from_surface.se3()
    yield from _above_table("surface.place_from_surface puts the surface", on_place, _corners(low, high))
    for area in job.surface.area:
        if (area.corners[0] > high[:2]).any() or (area.corners[1] < low[:2]).any():
            yield f'surface.area "{area.name}" lies beside the surface; correct its centre or size'
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
