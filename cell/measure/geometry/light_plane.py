"""The laser's light plane in the camera frame, and triangulation: where a pixel's ray meets it.

A sheet may be bowed across the stripe's length:
what lens and laser leave of it, a few hundredths of a millimetre. docs/explanation/theory.md, section 2.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from cell.measure.geometry.camera import Array, CameraModel

# A ray that makes less than this angle (as its sine) with the plane meets it nowhere useful.
VANISHING_SINE = 1e-6
# By so much the length of a normal that was divided by its length may be off 1.
ROUNDING = 1e-15


@dataclass(frozen=True)
class LightPlane:
    """The plane n·P = d: unit normal (3,), distance in m, in the camera frame. (n, d) and (−n, −d) are one plane.

    With a `bow` it is the sheet n·P = d + bow (t·P)²/P_z, with t along the stripe, across the optical axis: a fan whose
    rays leave the plane with the square of their angle, as seen from near the camera.
    """

    normal: tuple[float, float, float]
    distance: float
    bow: float = 0.0

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.normal))
        if not 0.999 < length < 1.001:
            raise ValueError(f"the normal of a light plane must have length 1, not {length:.6g}: use LightPlane.of")

    @classmethod
    def of(cls, normal: ArrayLike, distance: float) -> Self:
        """The plane normal·P = distance with a normal of any length but zero; one of length 1 is kept to the bit."""
        n = np.asarray(normal, dtype=np.float64)
        length = float(np.linalg.norm(n))
        if not length > 0:
            raise ValueError("the normal of a light plane must not be zero")
        # What was made and stored is the same when it is read: divided again, its last bits would move.
        if abs(length - 1.0) < ROUNDING:
            length = 1.0
        x, y, z = (float(v) for v in n / length)
        return cls((x, y, z), float(distance) / length)

    @classmethod
    def from_baseline(cls, baseline: float, theta: float) -> Self:
        """The paper's set-up: laser at (−baseline, 0, 0) in m, plane X = −baseline + Z cot(theta), theta in rad."""
        return cls.of((1.0, 0.0, -1.0 / np.tan(theta)), -baseline)

    @classmethod
    def fit(cls, points: ArrayLike) -> Self:
        """Least-squares plane of points (n, 3). Paper, step 5 of section 4.1."""
        p = np.asarray(points, dtype=np.float64)
        centre = p.mean(axis=0)
        normal = np.linalg.svd(p - centre, full_matrices=False)[2][2]
        if normal @ centre < 0:
            normal = -normal
        return cls.of(normal, float(normal @ centre))

    def bowed(self, bow: float) -> Self:
        """The same plane with this bow (1: metres off the plane, per m² beside its middle and per 1/m of depth)."""
        return replace(self, bow=float(bow))

    @property
    def along(self) -> Array:
        """Unit vector (3,) along the stripe, across the optical axis."""
        return np.asarray(np.array([-self.normal[1], self.normal[0], 0.0]) / np.hypot(self.normal[0], self.normal[1]))

    def shape(self, points: ArrayLike) -> Array:
        """(t·P)²/P_z (n,) in m of points or rays (n, 3): how far a bow of 1 lifts the sheet off its plane there."""
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        return np.asarray((p @ self.along) ** 2 / p[:, 2], dtype=np.float64)

    @property
    def n(self) -> Array:
        """The unit normal as an array (3,)."""
        return np.array(self.normal)

    def distances(self, points: ArrayLike) -> Array:
        """Signed distances (n,) in m of points (n, 3) from the sheet."""
        away = np.asarray(np.asarray(points, dtype=np.float64) @ self.n - self.distance, dtype=np.float64)
        return away - self.bow * self.shape(points) if self.bow else away

    def intersect(self, rays: ArrayLike) -> Array:
        """Points (n, 3) in m where unit rays (n, 3) meet the sheet: P = d u/(n·u), less the bow's share of n·u. A ray
        near the plane's vanishing line, or one that would meet it behind the camera, gives NaN."""
        u = np.atleast_2d(np.asarray(rays, dtype=np.float64))
        return np.asarray(u * self._range(u)[:, None], dtype=np.float64)

    def intersect_with_jacobians(self, rays: ArrayLike) -> tuple[Array, Array, Array, Array]:
        """Points P (n, 3), ∂P/∂u (n, 3, 3), ∂P/∂n (n, 3, 3) and ∂P/∂d (n, 3) for unit rays u (n, 3).

        ∂P/∂u = s(I − u nᵀ/(n·u)) with s = d/(n·u); ∂P/∂n = −P Pᵀ/d; ∂P/∂d = P/d (docs/explanation/theory.md,
        section 2). On a bowed sheet n is its normal where the ray meets it.
        """
        u = np.atleast_2d(np.asarray(rays, dtype=np.float64))
        s = self._range(u)
        points = u * s[:, None]
        slant = self._slant(u)
        normals = np.broadcast_to(self.n, u.shape)
        if self.bow:
            beside = (u @ self.along / u[:, 2])[:, None]
            normals = normals - self.bow * (2.0 * beside * self.along - beside**2 * np.array([0.0, 0.0, 1.0]))
        by_ray = s[:, None, None] * (np.eye(3) - u[:, :, None] * normals[:, None, :] / slant[:, None, None])
        by_normal = -points[:, :, None] * points[:, None, :] / self.distance
        return points, by_ray, by_normal, points / self.distance

    def _slant(self, u: Array) -> Array:
        slant = u @ self.n
        return np.asarray(slant - self.bow * self.shape(u)) if self.bow else slant

    def _range(self, u: Array) -> Array:
        slant = self._slant(u)
        usable = (np.abs(slant) > VANISHING_SINE) & (slant * self.distance > 0)
        distances = np.full(len(u), np.nan)
        np.divide(self.distance, slant, out=distances, where=usable)
        return distances


def triangulate(camera: CameraModel, plane: LightPlane, pixels: ArrayLike) -> tuple[Array, Array]:
    """Points (n, 3) in m in the camera frame of stripe pixels (n, 2), and ∂P/∂pixel (n, 3, 2) in m/px. NaN where a
    pixel's ray does not meet the plane in front of the camera."""
    rays, ray_by_pixel = camera.rays_with_jacobian(pixels)
    points, by_ray, _, _ = plane.intersect_with_jacobians(rays)
    return points, np.asarray(by_ray @ ray_by_pixel, dtype=np.float64)
