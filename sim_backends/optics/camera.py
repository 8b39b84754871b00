"""Pin-hole camera with Brown distortion, thin-lens defocus and mild vignetting, as the simulated cameras see the world.

Camera frame: z along the optical axis, x to the right, y down the image; metres. Pixel centres lie at whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled

Vector = NDArray[np.float64]
Plane = NDArray[np.float32]


@dataclass(frozen=True)
class CameraOptics:
    """One camera.

    `fx, fy, cx, cy` in pixels, `distortion` = k1, k2, p1, p2, k3 (Brown), `pixel`, `focal`, `focus_distance` in m.
    `psf_px` is the standard deviation of the lens's point spread in focus, `vignetting` the loss of light in the
    image corner (0…1), `transmission` the share of ambient light that the filter passes (a scan camera has a
    narrow-band filter; the laser passes fully).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    pixel: float = 4.8e-6
    f_number: float = 4.0
    focal: float = 8e-3
    focus_distance: float = 0.130
    electrons_per_dn: float = 40.0
    read_noise_dn: float = 0.4
    psf_px: float = 0.6
    vignetting: float = 0.08
    transmission: float = 1.0

    @property
    def intrinsics(self) -> Vector:
        """(9,) fx, fy, cx, cy, k1, k2, p1, p2, k3: the form that the kernels take."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion])

    def project(self, points: Vector) -> Vector:
        """Project (n, 3) points in the camera frame to (n, 2) distorted pixels; NaN for points behind the camera."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        return project_points(points, self.intrinsics)

    def undistort(self, pixels: Vector) -> Vector:
        """Normalised image coordinates (n, 2), z = 1, that distort to the pixels (n, 2)."""
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        return undistort_pixels(pixels, self.intrinsics)

    def blur_px(self, distance: float | Vector) -> float | Vector:
        """Standard deviation in pixels of point spread and defocus together at `distance` (m) along the axis.

        Defocus is a disc of diameter (f/N) f |s2 − s1| / (s2 (s1 − f)) (docs/explanation/theory.md, section 4); a disc
        of diameter b has the standard deviation b/4 along each axis.
        """
        disc = blur_disc(self.focal, self.f_number, self.focus_distance, distance) / self.pixel
        return np.sqrt(self.psf_px**2 + disc**2 / 16)

    def rays(self) -> tuple[Plane, Plane]:
        """Normalised coordinates x and y of every pixel centre, two (height, width) float32 arrays, made once."""
        return _rays(self)


def blur_disc(focal: float, f_number: float, focus: float, distance: float | Vector) -> float | Vector:
    """Diameter in m on the sensor of the blur disc of a point at `distance` when the lens is focused at `focus`."""
    return (focal / f_number) * focal * np.abs(distance - focus) / (distance * (focus - focal))


@lru_cache(maxsize=16)
def _rays(optics: CameraOptics) -> tuple[Plane, Plane]:
    u, v = np.meshgrid(np.arange(optics.width, dtype=np.float64), np.arange(optics.height, dtype=np.float64))
    normalised = optics.undistort(np.column_stack([u.ravel(), v.ravel()])).astype(np.float32)
    shape = (optics.height, optics.width)
    return normalised[:, 0].reshape(shape).copy(), normalised[:, 1].reshape(shape).copy()


@compiled
def distort(x: float, y: float, k: Vector) -> tuple[float, float]:
    """Pixel of the normalised coordinates (x, y); `k` as `CameraOptics.intrinsics`."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]))
    xd = x * radial + 2.0 * k[6] * x * y + k[7] * (r2 + 2.0 * x * x)
    yd = y * radial + k[6] * (r2 + 2.0 * y * y) + 2.0 * k[7] * x * y
    return k[0] * xd + k[2], k[1] * yd + k[3]


@compiled
def distort_jacobian(x: float, y: float, k: Vector) -> tuple[float, float, float, float]:
    """Return ∂u/∂x, ∂u/∂y, ∂v/∂x, ∂v/∂y of `distort`."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]))
    slope = 2.0 * (k[4] + r2 * (2.0 * k[5] + 3.0 * r2 * k[8]))
    ux = radial + slope * x * x + 2.0 * k[6] * y + 6.0 * k[7] * x
    uy = slope * x * y + 2.0 * k[6] * x + 2.0 * k[7] * y
    vy = radial + slope * y * y + 6.0 * k[6] * y + 2.0 * k[7] * x
    return k[0] * ux, k[0] * uy, k[1] * uy, k[1] * vy


@compiled
def step_on_plane(
    point: Vector, normal: Vector, du: float, dv: float, intrinsics: Vector
) -> tuple[float, float, float]:
    """How a point (3,) on its tangent plane of this normal (3,) moves, m, as its picture moves by (du, dv) px.

    Not finite where the plane is seen edge on.
    """
    z = point[2]
    x, y = point[0] / z, point[1] / z
    ux, uy, vx, vy = distort_jacobian(x, y, intrinsics)
    det = ux * vy - uy * vx
    dx, dy = (vy * du - uy * dv) / det, (ux * dv - vx * du) / det
    dz = -z * (normal[0] * dx + normal[1] * dy) / (normal[0] * x + normal[1] * y + normal[2])
    return z * dx + dz * x, z * dy + dz * y, dz


@compiled
def project_points(points: Vector, k: Vector) -> Vector:
    """Compiled core of `CameraOptics.project`."""
    pixels = np.empty((points.shape[0], 2))
    for i in range(points.shape[0]):
        z = points[i, 2]
        if z <= 1e-6:
            pixels[i, 0] = np.nan
            pixels[i, 1] = np.nan
        else:
            pixels[i, 0], pixels[i, 1] = distort(points[i, 0] / z, points[i, 1] / z, k)
    return pixels


@compiled
def undistort_pixels(pixels: Vector, k: Vector) -> Vector:
    """Compiled core of `CameraOptics.undistort`: Newton's method on the distortion, from the undistorted guess."""
    normalised = np.empty((pixels.shape[0], 2))
    for i in range(pixels.shape[0]):
        x = (pixels[i, 0] - k[2]) / k[0]
        y = (pixels[i, 1] - k[3]) / k[1]
        for _ in range(12):
            u, v = distort(x, y, k)
            ux, uy, vx, vy = distort_jacobian(x, y, k)
            det = ux * vy - uy * vx
            du = pixels[i, 0] - u
            dv = pixels[i, 1] - v
            x += (vy * du - uy * dv) / det
            y += (ux * dv - vx * du) / det
            if du * du + dv * dv < 1e-20:
                break
        normalised[i, 0] = x
        normalised[i, 1] = y
    return normalised
