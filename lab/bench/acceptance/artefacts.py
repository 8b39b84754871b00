"""The artefacts of an acceptance test: ball, ball bar and flat, where they are put, and scans of them.

Every frame is rendered by the simulator's optics with speckle and sensor noise; stripe, cloud and outlier filter are
the product's own. Frame: the camera's at rail position 0, m.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_axes, from_parts
from cell.measure.reconstruction import Cloud, ProfileBuilder, ScanGeometry
from cell.measure.vision import StripeStream
from lab.paper.rig import RigSpec, TrueHead
from sim_backends.optics import Mesh, MeshInstance, PlaneInstance, SceneObject, render

Array = NDArray[np.float64]

BALL_DIAMETER = 0.015
SPACING = 0.050
FLAT = (0.050, 0.030)
"""Length and width of the flat, m."""
STEP = 0.5e-3
"""Rail travel between profiles, m."""
EXPOSURE = 0.002
ALBEDO = 0.7
FACING = np.diag([1.0, -1.0, -1.0])
"""Axes of an artefact that faces the camera: z up at it."""


@cache
def ball_mesh() -> Mesh:
    """The upper part of a ball about the origin, to 80° from its z axis; 0.2 µm from round."""
    rings, sectors = 110, 420
    polar = np.radians(80.0) * np.arange(1, rings + 1) / rings
    angle = 2 * np.pi * np.arange(sectors) / sectors
    ring = np.stack(
        [np.outer(np.sin(polar), np.cos(angle)), np.outer(np.sin(polar), np.sin(angle)),
         np.repeat(np.cos(polar)[:, None], sectors, axis=1)], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    vertices = 0.5 * BALL_DIAMETER * np.vstack([[0.0, 0.0, 1.0], ring])
    k, following = np.arange(sectors), (np.arange(sectors) + 1) % sectors
    faces = [np.column_stack([np.zeros(sectors, dtype=np.intp), 1 + k, 1 + following])]
    for r in range(rings - 1):
        a, b = 1 + r * sectors, 1 + (r + 1) * sectors
        faces.append(np.column_stack([a + k, b + k, b + following]))
        faces.append(np.column_stack([a + k, b + following, a + following]))
    return Mesh(vertices, np.vstack(faces))


def ball_places(spec: RigSpec) -> list[Array]:
    """Ten places of the ball over the measuring volume, VDI/VDE 2634 part 2: corners, middle and one aside."""
    near, far = spec.depths[0] + 0.004, spec.depths[1] - 0.002
    low, high, half = 0.2 * spec.travel, 0.8 * spec.travel, 0.008
    middle = 0.5 * spec.travel
    places = [(x, y, z) for x in (low, high) for y in (-half, half) for z in (near, far)]
    return [np.array(p) for p in [*places, (middle, 0.0, 0.5 * (near + far)), (middle, half, near)]]


def bar_places(spec: RigSpec) -> list[tuple[Array, Array]]:
    """Seven places of the ball bar: along the sweep near, midway and far, across it, and along the diagonals."""
    near, far = spec.depths[0] + 0.004, spec.depths[1] - 0.002
    depth, middle = 0.5 * (near + far), 0.5 * spec.travel
    aside, rise = 0.008, 0.5 * (far - near)

    def bar(across: float, up: float, at: float) -> tuple[Array, Array]:
        half = np.array([np.sqrt((0.5 * SPACING) ** 2 - across**2 - up**2), across, up])
        centre = np.array([middle, 0.0, at])
        return centre - half, centre + half

    return [
        bar(0.0, 0.0, near),
        bar(0.0, 0.0, far),
        bar(aside, 0.0, depth),
        bar(-aside, 0.0, depth),
        bar(0.0, rise, depth),
        bar(aside, -rise, depth),
        bar(-aside, rise, depth),
    ]


def flat_poses(spec: RigSpec) -> list[pin.SE3]:
    """Six poses of the flat: near, midway and far, and tilted about both its axes."""
    near, far = spec.depths[0] + 0.002, spec.depths[1] - 0.002
    depth, middle = 0.5 * (near + far), 0.5 * spec.travel
    tilts = [(0.0, 0.0, near), (0.0, 0.0, depth), (0.0, 0.0, far), (0.3, 0.0, depth), (0.0, 0.25, depth),
             (-0.2, -0.2, depth)]  # fmt: skip
    return [from_parts((middle, 0.0, z), FACING @ pin.exp3(np.array([a, b, 0.0]))) for a, b, z in tilts]


def scan_balls(
    spec: RigSpec, head: TrueHead, geometry: ScanGeometry, centres: list[Array], rng: np.random.Generator
) -> list[Cloud]:
    """A cloud of each ball, all in one set-up: one sweep over each."""
    objects: list[tuple[pin.SE3, Mesh | None]] = [(from_parts(centre, FACING), ball_mesh()) for centre in centres]
    reach = 0.5 * BALL_DIAMETER
    return [
        _scan(spec, head, geometry, objects, _window(spec, head, centre, reach), rng) for centre in centres
    ]  # fmt: skip


def scan_flat(spec: RigSpec, head: TrueHead, geometry: ScanGeometry, pose: pin.SE3, rng: np.random.Generator) -> Cloud:
    """A cloud of the flat."""
    window = _window(spec, head, pose.translation, 0.5 * FLAT[0])
    return _scan(spec, head, geometry, [(pose, None)], window, rng)


def _window(spec: RigSpec, head: TrueHead, centre: Array, reach: float) -> Array:
    """Rail positions (n,) in m at which the light plane passes over what lies within `reach` m of the centre."""
    normal = np.asarray(head.laser.normal)
    middle = float((normal @ centre - head.laser.distance) / (normal @ head.rail_direction))
    half = reach + 0.001
    positions = np.clip(np.arange(middle - half, middle + half, STEP), 0.0, spec.travel)
    return np.asarray(np.unique(positions), dtype=np.float64)


def _scan(
    spec: RigSpec,
    head: TrueHead,
    geometry: ScanGeometry,
    objects: list[tuple[pin.SE3, Mesh | None]],
    readings: Array,
    rng: np.random.Generator,
) -> Cloud:
    builder, stripes = ProfileBuilder(geometry, len(readings)), StripeStream()
    for reading in readings:
        scene: list[SceneObject] = []
        for pose, mesh in objects:
            seen = pose.homogeneous.copy()
            seen[:3, 3] -= reading * head.rail_direction
            scene.append(PlaneInstance(seen, FLAT, ALBEDO) if mesh is None else MeshInstance(seen, mesh, ALBEDO))
        frame = render(head.optics, scene, head.laser, EXPOSURE, rng)
        measured = float(reading + spec.noise.rail * rng.standard_normal())
        builder.add(stripes.extract(frame), measured, spec.noise.rail)
    return builder.finish(from_axes((0, 0, 0), x=(1, 0, 0), z=(0, 0, 1)), least_points=100)
