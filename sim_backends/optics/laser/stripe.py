"""The laser stripe: where the light plane's cut through the scene crosses each image row, and how bright it is there.

The cut of every object is a set of straight segments; each is followed to the image rows' centres exactly, seen from
the camera and lit by the laser or not at all. What is drawn is the Gaussian of the sheet's thickness as the camera
sees it on the slope, widened by point spread and defocus, integrated over pixels (docs/explanation/theory.md, section
4).
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from sim_backends.optics.boards import appearance
from sim_backends.optics.camera import CameraOptics, distort, distort_jacobian
from sim_backends.optics.compiled import compiled
from sim_backends.optics.laser.profile import expose
from sim_backends.optics.laser.sheet import HALO, HALO_AT, WET, bend, laser_frame, light_at, lit, oiled, slide
from sim_backends.optics.pattern import grain_parameters
from sim_backends.optics.scene import LaserOptics, MeshInstance, PlaneInstance, SceneObject

Vector = NDArray[np.float64]
Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where a stripe crosses rows: `rows` (n,), `columns` u (n,) px, `slopes` du/dv (n,), and in the camera frame
    the lit `points` (n, 3) m and the surfaces' unit `normals` (n, 3)."""

    rows: NDArray[np.int64]
    columns: Vector
    slopes: Vector
    points: Vector
    normals: Vector

    def keep(self, mask: NDArray[np.bool_]) -> "Crossings":
        """Only those crossings where `mask` (n,) holds."""
        return Crossings(self.rows[mask], self.columns[mask], self.slopes[mask], self.points[mask], self.normals[mask])


def crossings(optics: CameraOptics, laser: LaserOptics, instance: SceneObject) -> Crossings:
    """Row crossings of one object by itself, without regard to shading."""
    normal, distance, _ = laser_frame(laser)
    if isinstance(instance, MeshInstance):
        pose = np.asarray(instance.camera_from_mesh, dtype=np.float64)
        turned = np.ascontiguousarray(pose[:3, :3].T @ normal)
        segments, normals = instance.mesh.section(turned, distance - float(normal @ pose[:3, 3]))
        normals = normals @ pose[:3, :3].T
        segments = segments @ pose[:3, :3].T + pose[:3, 3]
    else:
        pose, pattern = appearance(instance)
        segments = rectangle_section(pose, pattern, normal, distance)
        normals = np.repeat(pose[None, :3, 2], len(segments), axis=0)
    capacity = optics.height + 64 * len(segments)
    rows = np.empty(capacity, dtype=np.int64)
    values = np.empty((capacity, 8))
    count = follow(
        np.ascontiguousarray(segments), np.ascontiguousarray(normals), optics.intrinsics, width=optics.width,
        height=optics.height, rows=rows, values=values,
    )  # fmt: skip
    values = values[:count]
    if laser.bow != 0.0 and count:
        columns, points = values[:, 0].copy(), values[:, 2:5].copy()
        bend(columns, points, values[:, 5:8].copy(), optics.intrinsics, laser)
        values[:, 0], values[:, 2:5] = columns, points
    return Crossings(rows[:count], values[:, 0], values[:, 1], values[:, 2:5], values[:, 5:8])


def rectangle_section(pose: Vector, pattern: Vector, normal: Vector, distance: float) -> Vector:
    """Segment (0 or 1, 2, 3) in the camera frame that the light plane cuts out of a rectangle."""
    x0, x1, y0, y1 = pattern[4:8]
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]]) @ pose[:3, :3].T + pose[:3, 3]
    height = corners @ normal - distance
    ends = []
    for i, j in ((0, 1), (1, 2), (2, 3), (3, 0)):
        if (height[i] >= 0) != (height[j] >= 0):
            ends.append(corners[i] + height[i] / (height[i] - height[j]) * (corners[j] - corners[i]))
    return np.array([ends]) if len(ends) == 2 else np.empty((0, 2, 3))


def render_stripe(
    image: Image, optics: CameraOptics, laser: LaserOptics, scene: list[SceneObject], exposure: float
) -> NDArray[np.int64]:
    """Add the stripe's light to `image` (height, width) in DN, without speckle; returns for each row the columns
    (height, 2) that it touches (first, last + 1; equal where there is none)."""
    normal, _, origin = laser_frame(laser)
    touched = np.zeros((optics.height, 2), dtype=np.int64)
    touched[:, 0] = optics.width
    camera = np.array(
        [optics.focal, optics.f_number, optics.focus_distance, optics.pixel, optics.psf_px, optics.vignetting]
    )
    for instance in scene:
        met, share = instance, None
        if isinstance(instance, PlaneInstance):
            width, height = np.array(instance.size) + 2 * RIM * _spread(instance, laser)
            met = replace(instance, size=(float(width), float(height)))
        found = crossings(optics, laser, met)
        if len(found.rows):
            found = found.keep(lit(found.points, found.normals, instance, scene, laser))
        if not len(found.rows):
            continue
        grain = None
        if isinstance(instance, PlaneInstance):
            share = share_on(instance, laser, found.points)
        if isinstance(instance, MeshInstance):
            grain = instance.grain
            pose = np.asarray(instance.camera_from_mesh, dtype=np.float64)
            pattern = grain_parameters(instance.albedo, grain)
        else:
            pose, pattern = appearance(instance)
        factors = light_at(found.points, found.normals, laser, grain) * (1.0 if share is None else share)
        thick = oiled(found.points, pose, None if grain is None else grain.oil)
        wet = thick > 0.0
        drawn = [(found, np.where(wet, WET, 1.0) * factors)]
        if wet.any():
            drawn.append((_halo(found.keep(wet), thick[wet], optics, laser), HALO * WET * factors[wet]))
        for crossed, light in drawn:
            points, normals = np.ascontiguousarray(crossed.points), np.ascontiguousarray(crossed.normals)
            expose(
                image, touched, crossed.rows, columns=crossed.columns, slopes=crossed.slopes, points=points,
                normals=normals, factors=light, intrinsics=optics.intrinsics, camera=camera, plane_normal=normal,
                origin=origin, sheet=laser.width, brightness=laser.brightness * exposure,
                pose=np.ascontiguousarray(pose), pattern=pattern,
            )  # fmt: skip
    return touched


def _halo(found: Crossings, thick: Vector, optics: CameraOptics, laser: LaserOptics) -> Crossings:
    """The crossings of the light that leaves oil so `thick` (n,) beside the stripe, on the laser's far side."""
    columns, points = found.columns.copy(), np.array(found.points)
    normals, (plane, _, origin) = np.ascontiguousarray(found.normals), laser_frame(laser)
    away = -np.sign(origin[0] * plane[0])
    slide(columns, points, normals, optics.intrinsics, plane=plane, sag=away * HALO_AT * thick)
    return replace(found, columns=columns, points=points)


RIM = 3.0
"""Standard deviations of the sheet's thickness by which its middle may pass a plate that its flank still meets."""


def share_on(instance: PlaneInstance, laser: LaserOptics, points: Vector) -> Vector:
    """How much (n,) of a sheet with its thickness meets a rectangle where its middle meets the plane, points (n, 3)."""
    pose, spread = np.asarray(instance.camera_from_plane, dtype=np.float64), _spread(instance, laser)
    beyond = np.abs((points - pose[:3, 3]) @ pose[:3, :2]) - np.array(instance.size) / 2
    return np.asarray(scipy.special.ndtr(-beyond / np.maximum(spread, 1e-9)).prod(axis=1))


def _spread(instance: PlaneInstance, laser: LaserOptics) -> Vector:
    """How far (2,) along the rectangle's axes the line moves with the sheet, for one standard deviation of it, m."""
    normal, _, _ = laser_frame(laser)
    across = np.asarray(instance.camera_from_plane, dtype=np.float64)[:3, :2].T @ normal
    return np.asarray(laser.width * np.abs(across) / max(float(across @ across), 1e-6))


@compiled
def seen_part(
    ax: float, ay: float, az: float, dx: float, dy: float, dz: float, reach_x: float, reach_y: float
) -> tuple[float, float]:
    """Where, from 0 to 1, a segment from a along d is in front of the camera and within its cone. Beyond it the
    distortion folds back."""
    low, high = 0.0, 1.0
    for side in range(5):
        if side == 0:
            f0, df = az - 1e-3, dz
        elif side == 1:
            f0, df = reach_x * az - ax, reach_x * dz - dx
        elif side == 2:
            f0, df = reach_x * az + ax, reach_x * dz + dx
        elif side == 3:
            f0, df = reach_y * az - ay, reach_y * dz - dy
        else:
            f0, df = reach_y * az + ay, reach_y * dz + dy
        if f0 < 0.0 and f0 + df < 0.0:
            high = -1.0
        elif f0 < 0.0:
            low = max(low, -f0 / df)
        elif f0 + df < 0.0:
            high = min(high, -f0 / df)
    return low, high


@compiled
def follow(
    segments: Vector, normals: Vector, intrinsics: Vector, width: int, height: int, rows: NDArray[np.int64],
    values: Vector,
) -> int:  # fmt: skip
    """Row crossings of straight segments (k, 2, 3): columns of `values` are u, du/dv, point, normal."""
    count = 0
    for s in range(segments.shape[0]):
        ax, ay, az = segments[s, 0, 0], segments[s, 0, 1], segments[s, 0, 2]
        bx, by, bz = segments[s, 1, 0], segments[s, 1, 1], segments[s, 1, 2]
        dx, dy, dz = bx - ax, by - ay, bz - az
        reach_x = 1.5 * max(width - intrinsics[2], intrinsics[2]) / intrinsics[0]
        reach_y = 1.5 * max(height - intrinsics[3], intrinsics[3]) / intrinsics[1]
        low, high = seen_part(ax, ay, az, dx=dx, dy=dy, dz=dz, reach_x=reach_x, reach_y=reach_y)
        if low >= high:
            continue
        z = az + low * dz
        u_low, v_low = distort((ax + low * dx) / z, (ay + low * dy) / z, intrinsics)
        z = az + high * dz
        u_high, v_high = distort((ax + high * dx) / z, (ay + high * dy) / z, intrinsics)
        if v_low > v_high:
            low, high = high, low
            u_low, v_low, u_high, v_high = u_high, v_high, u_low, v_low
        first = max(int(np.ceil(v_low)), 0)
        last = min(int(np.ceil(v_high)) - 1, height - 1)
        for row in range(first, last + 1):
            if count >= rows.shape[0]:
                return count
            t = low + (high - low) * (row - v_low) / (v_high - v_low)
            u = 0.0
            slope = 0.0
            for _ in range(8):
                z = az + t * dz
                x, y = (ax + t * dx) / z, (ay + t * dy) / z
                u, v = distort(x, y, intrinsics)
                ux, uy, vx, vy = distort_jacobian(x, y, intrinsics)
                xt, yt = (dx - x * dz) / z, (dy - y * dz) / z
                vt = vx * xt + vy * yt
                if vt == 0.0:
                    break
                slope = (ux * xt + uy * yt) / vt
                if abs(row - v) < 1e-7:
                    break
                t += (row - v) / vt
            if u < -20.0 or u > width + 20.0:
                continue
            rows[count] = row
            values[count, 0] = u
            values[count, 1] = slope
            values[count, 2] = ax + t * dx
            values[count, 3] = ay + t * dy
            values[count, 4] = az + t * dz
            values[count, 5] = normals[s, 0]
            values[count, 6] = normals[s, 1]
            values[count, 7] = normals[s, 2]
            count += 1
    return count
