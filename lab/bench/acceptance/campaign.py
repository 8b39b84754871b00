"""Acceptance tests of the trade on a simulated head: probing error, sphere spacing error and flatness.

After VDI/VDE 2634 part 2 and ISO 10360-13: a ball at ten places, a ball bar at seven, a flat at six; the worst place
counts. Both fit by least squares and judge what is left: the first over all points but the few per mille that it lets
go, the second over all points and over 95 % of them. Every frame is rendered by the simulator's optics with speckle and
sensor noise; stripe, cloud and outlier filter are the product's own. Frame: the camera's at rail position 0, m.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_parts
from cell.measure.reconstruction.build import ScanGeometry
from cell.measure.reconstruction.cloud import Cloud
from cell.measure.vision.stripe.extract import StripeStream
from drivers.errors import RefusedError
from lab.bench.calibration.world import Noise
from lab.bench.over_cores import Done
from lab.bench.reconstruction.scenes import swept
from lab.paper.rig import RigSpec, TrueHead, draw_head, from_axes, in_scan_frame, observe, solve
from sim_backends.optics import Mesh, MeshInstance, PlaneInstance, SceneObject, render
from sim_backends.world.levels import deviations

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
        bar(0.0, 0.0, near), bar(0.0, 0.0, far), bar(aside, 0.0, depth), bar(-aside, 0.0, depth), bar(0.0, rise, depth),
        bar(aside, -rise, depth), bar(-aside, rise, depth),
    ]  # fmt: skip


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
    spec: RigSpec, head: TrueHead, geometry: ScanGeometry, objects: list[tuple[pin.SE3, Mesh | None]],
    readings: Array, rng: np.random.Generator,
) -> Cloud:  # fmt: skip
    profiles, stripes = [], StripeStream()
    for reading in readings:
        scene: list[SceneObject] = []
        for pose, mesh in objects:
            seen = pose.homogeneous.copy()
            seen[:3, 3] -= reading * head.rail_direction
            scene.append(PlaneInstance(seen, FLAT, ALBEDO) if mesh is None else MeshInstance(seen, mesh, ALBEDO))
        frame = render(head.optics, scene, head.laser, EXPOSURE, rng)
        measured = float(reading + spec.noise.rail * rng.standard_normal())
        profiles.append((stripes.extract(frame), measured))
    here = from_axes((0, 0, 0), x=(1, 0, 0), z=(0, 0, 1))
    return swept(geometry, profiles, spec.noise.rail, here, least_points=100)


CAP = float(np.radians(50.0))
"""Part of a ball that is judged: within this angle of the direction to the head, where stripe and lens can see it."""
FLAT_BORDER = 0.001
"""Border of the flat that is left out, m: mixed pixels."""
NOISE_FACTOR = {"ideal": 0.1, "nominal": 1.0, "harsh": 2.5, "workshop": 1.0, "outdoor": 1.0}
"""Of the scan head's noise. Alone, on its bench, the head has of a workshop only what its drawing may be off."""
LET_GO = 0.003
"""Share of the points that VDI/VDE 2634 part 2 lets the tester leave out of a form error."""
MOST = 0.95
"""Share of the points that the second form error of ISO 10360-13 is about."""
LEAST_POINTS = 50
GAUSS_95 = 2 * 1.959964
"""Width of the band that holds 95 % of a Gaussian variable, in standard deviations."""
PLACES = 23
"""Of ball, ball bar and flat together."""


def acceptance(seed: int, level: str, done: Done = lambda name: None) -> dict[str, Any]:
    """The three tests on the head of `seed` at a level of deviations, calibrated first. Lengths in mm.

    `worst` has the figures that a limit would be set on: `probing_form_mm` (all points but 3 ‰), `probing_form_95_mm`
    (95 % of them), `probing_size_mm` (measured minus true diameter), `sphere_spacing_mm` (measured minus true distance
    of the balls' centres), `flatness_mm` and `flatness_95_mm`; errors of size and spacing keep the sign of the largest.
    `expected` has the 95 % forms that the stated σ of the points lets one expect from noise alone. ValueError for an
    unknown level.
    """
    sigma = deviations(level)
    spec = RigSpec(noise=Noise().times(NOISE_FACTOR[level]))
    rng = np.random.default_rng([seed, 2634])
    head = draw_head(spec, rng, level)
    geometry = in_scan_frame(solve(spec, observe(spec, head, rng)).joint)
    found: dict[str, list[dict[str, float]]] = {"ball": [], "bar": [], "flat": []}

    def step(name: str, row: dict[str, float]) -> None:
        found[name].append(row)
        done(name)

    for centre in ball_places(spec):
        cloud = scan_balls(spec, head, geometry, [centre], rng)[0]
        step("ball", _probing(cloud, BALL_DIAMETER))
    for ends in bar_places(spec):
        clouds = scan_balls(spec, head, geometry, list(ends), rng)
        step("bar", _spacing(clouds, float(np.linalg.norm(ends[1] - ends[0]))))
    for pose in flat_poses(spec):
        step("flat", _flatness(scan_flat(spec, head, geometry, pose, rng)))
    return {
        "note": "simulated; after VDI/VDE 2634 part 2 and ISO 10360-13, raw points, no smoothing",
        "seed": seed,
        "level": level,
        "assumed_noise": {
            **spec.noise.as_dict(),
            "speckle_contrast": sigma.speckle_contrast,
            "read_noise_dn": sigma.read_noise,
        },
        "artefacts": {
            "ball_diameter_mm": 1e3 * BALL_DIAMETER,
            "ball_spacing_mm": 1e3 * SPACING,
            "flat_mm": [1e3 * side for side in FLAT],
            "cap_deg": float(np.degrees(CAP)),
            "volume_mm": [1e3 * spec.travel, 1e3 * (2 * 0.008 + BALL_DIAMETER),
                          1e3 * (spec.depths[1] - spec.depths[0])],
        },
        "worst": {
            "probing_form_mm": _worst(found["ball"], "form_mm"),
            "probing_form_95_mm": _worst(found["ball"], "form_95_mm"),
            "probing_size_mm": _worst(found["ball"], "size_mm"),
            "sphere_spacing_mm": _worst(found["bar"], "spacing_mm"),
            "flatness_mm": _worst(found["flat"], "form_mm"),
            "flatness_95_mm": _worst(found["flat"], "form_95_mm"),
        },
        "expected": {
            "probing_form_95_mm": _worst(found["ball"], "expected_95_mm"),
            "flatness_95_mm": _worst(found["flat"], "expected_95_mm"),
        },
        "positions": found,
    }  # fmt: skip


def _ball(cloud: Cloud) -> "tuple[SphereFit, NDArray[np.bool_]]":
    """The sphere through the part of a ball that is judged, and which of the cloud's valid points those are."""
    points = cloud.points[cloud.valid]
    chosen = cap(points, fit_sphere(points).centre, np.array([0.0, 0.0, -1.0]), CAP)
    return fit_sphere(points[chosen]), chosen


def _probing(cloud: Cloud, diameter: float) -> dict[str, float]:
    fit, chosen = _ball(cloud)
    points = cloud.points[cloud.valid][chosen]
    normals = (points - fit.centre) / np.linalg.norm(points - fit.centre, axis=1, keepdims=True)
    return {
        "points": len(points), "form_mm": 1e3 * form_all(fit.deviations), "form_95_mm": 1e3 * form_95(fit.deviations),
        "size_mm": 1e3 * (2 * fit.radius - diameter), "expected_95_mm": 1e3 * _noise_band(cloud, chosen, normals),
    }  # fmt: skip


def _spacing(clouds: list[Cloud], true: float) -> dict[str, float]:
    first, second = (_ball(cloud)[0] for cloud in clouds)
    return {"spacing_mm": 1e3 * (float(np.linalg.norm(second.centre - first.centre)) - true)}


def _flatness(cloud: Cloud) -> dict[str, float]:
    points = cloud.points[cloud.valid]
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    along = centred @ axes[:2].T
    inside = (along > along.min(axis=0) + FLAT_BORDER).all(axis=1) & (along < along.max(axis=0) - FLAT_BORDER).all(
        axis=1
    )
    deviations_m = plane_deviations(points[inside])
    normals = np.broadcast_to(axes[2], (int(inside.sum()), 3))
    return {
        "points": int(inside.sum()),
        "form_mm": 1e3 * form_all(deviations_m),
        "form_95_mm": 1e3 * form_95(deviations_m),
        "expected_95_mm": 1e3 * _noise_band(cloud, inside, normals),
    }


def _noise_band(cloud: Cloud, chosen: NDArray[np.bool_], normals: Array) -> float:
    """Width in m of the band that holds 95 % of the chosen points when only their stated noise moves them."""
    lines, rows = cloud.valid.nonzero()
    sigma = cloud.sigma_along(lines[chosen], rows[chosen], normals)
    return float(GAUSS_95 * np.sqrt(np.mean(sigma**2)))


def _worst(rows: list[dict[str, float]], key: str) -> float:
    return float(max([row[key] for row in rows], key=abs))


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A sphere: `centre` (3,) and `radius` in m, and the points' `deviations` (n,) from it, outside positive."""

    centre: Array
    radius: float
    deviations: Array


def fit_sphere(points: Array) -> SphereFit:
    """Least-squares sphere of points (n, 3) in m, radius free. Raises `RefusedError` for too few points."""
    _enough(points, "sphere")
    middle = points.mean(axis=0)
    near = points - middle
    # |p|² = 2 c·p + (r² − |c|²) starts the Gauss–Newton on the distances themselves.
    columns = np.column_stack([2 * near, np.ones(len(near))])
    c, offset = np.split(np.linalg.lstsq(columns, np.sum(near**2, axis=1), rcond=None)[0], [3])
    radius = float(np.sqrt(offset[0] + c @ c))
    for _ in range(20):
        away = near - c
        length = np.linalg.norm(away, axis=1)
        step = np.linalg.lstsq(
            np.column_stack([away / length[:, None], np.ones(len(near))]), length - radius, rcond=None
        )
        c, radius = c + step[0][:3], radius + float(step[0][3])
        if np.linalg.norm(step[0]) < 1e-12:
            break
    return SphereFit(c + middle, radius, np.linalg.norm(near - c, axis=1) - radius)


def plane_deviations(points: Array) -> Array:
    """Signed distances (n,) in m of points (n, 3) from their least-squares plane."""
    _enough(points, "flat")
    centred = points - points.mean(axis=0)
    return np.asarray(centred @ np.linalg.svd(centred, full_matrices=False)[2][2])


def form_all(deviations: Array) -> float:
    """Form error over all points: largest minus smallest deviation, the 3 ‰ farthest off left out. Unit as given."""
    most = np.sort(np.abs(deviations - np.median(deviations)))[len(deviations) - 1 - int(LET_GO * len(deviations))]
    return float(np.ptp(deviations[np.abs(deviations - np.median(deviations)) <= most]))


def form_95(deviations: Array) -> float:
    """Form error over 95 % of the points: the narrowest band of deviations that holds so many. Unit as given."""
    ordered = np.sort(deviations)
    count = int(np.ceil(MOST * len(ordered)))
    return float((ordered[count - 1 :] - ordered[: len(ordered) - count + 1]).min())


def cap(points: Array, centre: Array, towards: Array, angle: float) -> NDArray[np.bool_]:
    """Which points (n, 3) lie on the part of a sphere within `angle` rad of the direction `towards` (3,)."""
    away = points - centre
    cosine = away @ (towards / np.linalg.norm(towards)) / np.linalg.norm(away, axis=1)
    return np.asarray(cosine > np.cos(angle))


def _enough(points: Array, what: str) -> None:
    if len(points) < LEAST_POINTS:
        raise RefusedError(
            f"the scan of a {what} has {len(points)} points, at least {LEAST_POINTS} are needed for a fit. Is it "
            "inside the measuring volume, and does the laser light it?"
        )
