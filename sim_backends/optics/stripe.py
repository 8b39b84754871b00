"""The laser stripe: where the light plane's cut through the scene crosses each image row, and how bright it is there.

The cut of every object is a set of straight segments; each is followed to the image rows' centres exactly, seen from
the camera and lit by the laser or not at all. What is drawn is the Gaussian of the sheet's thickness as the camera
sees it on the slope, widened by point spread and defocus, integrated over pixels (theory sheet, parts 2 and 6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.boards import albedo_at, appearance, plain_parameters
from sim_backends.optics.camera import CameraOptics, blur_disc, distort, distort_jacobian
from sim_backends.optics.compiled import compiled
from sim_backends.optics.scene import LaserOptics, MeshInstance, SceneObject

Vector = NDArray[np.float64]
Image = NDArray[np.float32]

REFERENCE_RANGE = 0.130
"""Distance from the laser in m at which `LaserOptics.brightness` holds."""
TOUCH = 5e-6
"""Surfaces nearer than this (m) to the lit point do not shade it: it is the surface itself."""
NARROWEST = 0.05
"""|∂(distance to the light plane)/∂(pixel)| in units of the facing value below which a grazing stripe stops widening."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where a stripe crosses rows: `rows` (n,), `columns` u (n,) px, `slopes` du/dv (n,), and in the camera frame
    the lit `points` (n, 3) m and the surfaces' unit `normals` (n, 3)."""

    rows: NDArray[np.int64]
    columns: Vector
    slopes: Vector
    points: Vector
    normals: Vector

    def keep(self, mask: NDArray[np.bool_]) -> Crossings:
        """Only those crossings where `mask` (n,) holds."""
        return Crossings(self.rows[mask], self.columns[mask], self.slopes[mask], self.points[mask], self.normals[mask])


def laser_frame(laser: LaserOptics) -> tuple[Vector, float, Vector]:
    """Unit normal, distance and origin (moved onto the plane) of the light plane in the camera frame."""
    normal = np.asarray(laser.normal, dtype=np.float64)
    length = float(np.linalg.norm(normal))
    if not 0.5 < length < 2.0:
        raise ValueError(f"light plane normal {laser.normal}: needs about unit length")
    normal, distance = normal / length, laser.distance / length
    origin = np.asarray(laser.origin, dtype=np.float64)
    return normal, distance, origin - (origin @ normal - distance) * normal


def crossings(optics: CameraOptics, laser: LaserOptics, instance: SceneObject) -> Crossings:
    """Row crossings of one object by itself, without regard to shading."""
    normal, distance, _ = laser_frame(laser)
    if isinstance(instance, MeshInstance):
        pose = np.asarray(instance.camera_from_mesh, dtype=np.float64)
        turned = np.ascontiguousarray(pose[:3, :3].T @ normal)
        segments, owners = instance.mesh.section(turned, distance - float(normal @ pose[:3, 3]))
        normals = instance.mesh.normals(owners) @ pose[:3, :3].T
        segments = segments @ pose[:3, :3].T + pose[:3, 3]
    else:
        pose, pattern = appearance(instance)
        segments = rectangle_section(pose, pattern, normal, distance)
        normals = np.repeat(pose[None, :3, 2], len(segments), axis=0)
    capacity = optics.height + 64 * len(segments)
    rows = np.empty(capacity, dtype=np.int64)
    values = np.empty((capacity, 8))
    count = follow(
        np.ascontiguousarray(segments),
        np.ascontiguousarray(normals),
        optics.intrinsics,
        optics.width,
        optics.height,
        rows,
        values,
    )
    values = values[:count]
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


def lit(found: Crossings, instance: SceneObject, scene: list[SceneObject], laser: LaserOptics) -> NDArray[np.bool_]:
    """Which crossings of `instance` the laser reaches and the camera sees, past every object of the scene."""
    normal, _, origin = laser_frame(laser)
    to_laser = origin - found.points
    facing_camera = -np.einsum("ij,ij->i", found.normals, found.points)
    facing_laser = np.einsum("ij,ij->i", found.normals, to_laser)
    axis = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    along = -(to_laser @ axis) / np.linalg.norm(axis) / np.linalg.norm(to_laser, axis=1)
    seen = (facing_camera * facing_laser > 0) & (along > np.cos(laser.fan))
    for other in scene:
        index = np.flatnonzero(seen)
        if not len(index):
            break
        if isinstance(other, MeshInstance):
            pose = np.asarray(other.camera_from_mesh, dtype=np.float64)
            # A plane that a mesh touches is covered by it; a mesh must not shade itself.
            start = TOUCH if isinstance(instance, MeshInstance) else -2 * TOUCH
            points = (found.points[index] - pose[:3, 3]) @ pose[:3, :3]
            for eye in (np.zeros(3), origin):
                hidden = other.mesh.hides(points, np.ascontiguousarray((eye - pose[:3, 3]) @ pose[:3, :3]), start)
                seen[index] &= ~hidden
        elif other is not instance:
            pose, pattern = appearance(other)
            for eye in (np.zeros(3), origin):
                seen[index] &= ~_rectangle_hides(pose, pattern, found.points[index], eye)
    return seen


def _rectangle_hides(pose: Vector, pattern: Vector, points: Vector, eye: Vector) -> NDArray[np.bool_]:
    start = (points - pose[:3, 3]) @ pose[:3, :3]
    end = (eye - pose[:3, 3]) @ pose[:3, :3]
    share = start[:, 2] / np.where(start[:, 2] == end[2], np.inf, start[:, 2] - end[2])
    crossing = start + share[:, None] * (end - start)
    inside = (
        (crossing[:, 0] > pattern[4])
        & (crossing[:, 0] < pattern[5])
        & (crossing[:, 1] > pattern[6])
        & (crossing[:, 1] < pattern[7])
    )
    past = share * np.linalg.norm(end - start, axis=1) > TOUCH
    return np.asarray(inside & past & (share < 1.0))


def render_stripe(
    image: Image, optics: CameraOptics, laser: LaserOptics, scene: list[SceneObject], exposure: float
) -> Image:
    """Add the stripe's light to `image` (height, width) in DN, without speckle; returns for each row the columns
    (height, 2) that it touches (first, last + 1; equal where there is none)."""
    normal, _, origin = laser_frame(laser)
    touched = np.zeros((optics.height, 2), dtype=np.int64)
    touched[:, 0] = optics.width
    camera = np.array(
        [optics.focal, optics.f_number, optics.focus_distance, optics.pixel, optics.psf_px, optics.vignetting]
    )
    for instance in scene:
        found = crossings(optics, laser, instance)
        if len(found.rows):
            found = found.keep(lit(found, instance, scene, laser))
        if not len(found.rows):
            continue
        if isinstance(instance, MeshInstance):
            pose = np.eye(4)
            pattern = plain_parameters((0.0, 0.0, 0.0, 0.0), instance.albedo)
        else:
            pose, pattern = appearance(instance)
        expose(
            image,
            touched,
            found.rows,
            found.columns,
            found.slopes,
            np.ascontiguousarray(found.points),
            np.ascontiguousarray(found.normals),
            optics.intrinsics,
            camera,
            normal,
            origin,
            laser.width,
            laser.brightness * exposure,
            np.ascontiguousarray(pose),
            pattern,
        )
    return touched


@compiled
def follow(
    segments: Vector,
    normals: Vector,
    intrinsics: Vector,
    width: int,
    height: int,
    rows: NDArray[np.int64],
    values: Vector,
) -> int:
    """Row crossings of straight segments (k, 2, 3): columns of `values` are u, du/dv, point, normal."""
    count = 0
    for s in range(segments.shape[0]):
        ax, ay, az = segments[s, 0, 0], segments[s, 0, 1], segments[s, 0, 2]
        bx, by, bz = segments[s, 1, 0], segments[s, 1, 1], segments[s, 1, 2]
        # Only the part in front of the camera and within its cone counts: beyond it the distortion folds back.
        low, high = 0.0, 1.0
        dx, dy, dz = bx - ax, by - ay, bz - az
        reach_x = 1.5 * max(width - intrinsics[2], intrinsics[2]) / intrinsics[0]
        reach_y = 1.5 * max(height - intrinsics[3], intrinsics[3]) / intrinsics[1]
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


@compiled
def erf(x: float) -> float:
    """Error function to 1.2e-7 (Numerical Recipes' Chebyshev fit of erfc)."""
    z = abs(x)
    if z > 4.5:
        return 1.0 if x > 0 else -1.0
    t = 1.0 / (1.0 + 0.5 * z)
    tail = t * np.exp(
        -z * z
        - 1.26551223
        + t
        * (
            1.00002368
            + t
            * (
                0.37409196
                + t
                * (
                    0.09678418
                    + t
                    * (
                        -0.18628806
                        + t * (0.27886807 + t * (-1.13520398 + t * (1.48851587 + t * (-0.82215223 + t * 0.17087277))))
                    )
                )
            )
        )
    )
    return 1.0 - tail if x >= 0 else tail - 1.0


@compiled
def add_gaussian(line: Image, centre: float, sigma: float, light: float) -> tuple[int, int]:
    """Add a Gaussian of total `light` (DN px) integrated over each pixel; returns the columns touched."""
    first = max(int(np.floor(centre - 4.0 * sigma)), 0)
    last = min(int(np.ceil(centre + 4.0 * sigma)), line.shape[0] - 1)
    scale = 1.0 / (np.sqrt(2.0) * sigma)
    before = erf((first - 0.5 - centre) * scale)
    for u in range(first, last + 1):
        after = erf((u + 0.5 - centre) * scale)
        line[u] += 0.5 * light * (after - before)
        before = after
    return first, last + 1


@compiled
def expose(
    image: Image,
    touched: NDArray[np.int64],
    rows: NDArray[np.int64],
    columns: Vector,
    slopes: Vector,
    points: Vector,
    normals: Vector,
    intrinsics: Vector,
    camera: Vector,
    plane_normal: Vector,
    origin: Vector,
    sheet: float,
    brightness: float,
    pose: Vector,
    pattern: Vector,
) -> None:
    """Draw crossings of one object. On a patterned board the sheet is cut into sub-sheets and sub-rows, each with the
    albedo under it, so that the edges of dots pull the stripe as they do in a real picture."""
    patterned = pattern[0] > 0
    width, height = image.shape[1], image.shape[0]
    sheets = 9 if patterned else 1
    sub_rows = 5 if patterned else 1
    corner = 1.0 / (0.25 * (width * width + height * height))
    for i in range(rows.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        mx, my, mz = normals[i, 0], normals[i, 1], normals[i, 2]
        x, y = px / pz, py / pz
        ux, uy, vx, vy = distort_jacobian(x, y, intrinsics)
        det = ux * vy - uy * vx
        # How the point on the tangent plane moves with u along the row and with v along the column.
        facing = mx * x + my * y + mz
        if facing == 0.0:
            continue
        xu, yu = vy / det, -vx / det
        zu = -pz * (mx * xu + my * yu) / facing
        gx, gy, gz = pz * xu + zu * x, pz * yu + zu * y, zu
        distance_per_px = plane_normal[0] * gx + plane_normal[1] * gy + plane_normal[2] * gz
        floor = NARROWEST * pz / intrinsics[0]
        if abs(distance_per_px) < floor:
            distance_per_px = floor if distance_per_px >= 0 else -floor
        geometric = sheet / abs(distance_per_px)
        lx, ly, lz = origin[0] - px, origin[1] - py, origin[2] - pz
        span = np.sqrt(lx * lx + ly * ly + lz * lz)
        incidence = abs(mx * lx + my * ly + mz * lz) / span
        a, b = columns[i] - 0.5 * (width - 1), rows[i] - 0.5 * (height - 1)
        light = brightness * incidence * REFERENCE_RANGE / span * (1.0 - camera[5] * (a * a + b * b) * corner)
        disc = camera[0] / camera[1] * camera[0] * abs(pz - camera[2]) / (pz * (camera[2] - camera[0])) / camera[3]
        lens = camera[4] * camera[4] + disc * disc / 16.0
        slope = min(max(slopes[i], -20.0), 20.0)
        row_width = np.sqrt(lens + 1.0 / 12.0)
        step = 0.6 * geometric
        total = 0.0
        for k in range(sheets):
            total += np.exp(-0.5 * (0.6 * (k - sheets // 2)) ** 2)
        row_total = 0.0
        for k in range(sub_rows):
            row_total += np.exp(-0.5 * (0.9 * (k - sub_rows // 2)) ** 2)
        first, last = width, 0
        for k in range(sheets):
            shift = step * (k - sheets // 2)
            albedo = pattern[8]
            variance = geometric * geometric + lens
            if patterned:
                weight = np.exp(-0.5 * (0.6 * (k - sheets // 2)) ** 2) / total
                variance = lens + step * step / 12.0
                albedo = 0.0
                for m in range(sub_rows):
                    rise = 0.9 * row_width * (m - sub_rows // 2)
                    # Along the stripe, one row further: the point on the plane seen at (u + slope, v + 1).
                    xs, ys = (vy * slope - uy) / det, (ux - vx * slope) / det
                    zs = -pz * (mx * xs + my * ys) / facing
                    qx = px + shift * gx + rise * (pz * xs + zs * x) - pose[0, 3]
                    qy = py + shift * gy + rise * (pz * ys + zs * y) - pose[1, 3]
                    qz = pz + shift * gz + rise * zs - pose[2, 3]
                    bx = pose[0, 0] * qx + pose[1, 0] * qy + pose[2, 0] * qz
                    by = pose[0, 1] * qx + pose[1, 1] * qy + pose[2, 1] * qz
                    share = np.exp(-0.5 * (0.9 * (m - sub_rows // 2)) ** 2) / row_total
                    albedo += weight * share * albedo_at(bx, by, pattern)
            sigma = np.sqrt(variance + slope * slope * (lens + 1.0 / 12.0))
            flux = light * albedo * np.sqrt(2.0 * np.pi) * geometric
            begin, end = add_gaussian(image[rows[i]], columns[i] + shift, sigma, flux)
            first, last = min(first, begin), max(last, end)
        if last > first:
            touched[rows[i], 0] = min(touched[rows[i], 0], first)
            touched[rows[i], 1] = max(touched[rows[i], 1], last)


def stripe_width_px(optics: CameraOptics, laser: LaserOptics, distance: float) -> float:
    """Standard deviation in px of the stripe on a surface that faces the camera at `distance` m, without pixel size."""
    normal, _, _ = laser_frame(laser)
    geometric = laser.width * optics.fx / (distance * abs(normal[0]))
    disc = blur_disc(optics.focal, optics.f_number, optics.focus_distance, distance) / optics.pixel
    return float(np.sqrt(geometric**2 + optics.psf_px**2 + disc**2 / 16))
