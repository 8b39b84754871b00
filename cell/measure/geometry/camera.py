"""The pinhole camera with Brown's lens, forwards and backwards, with derivatives; where a dot's middle is seen.

Camera frame: x right, y down, z into the scene, origin at the projection centre. Pixel (0, 0) is the middle of the
upper left pixel. The coefficients are OpenCV's k1, k2, p1, p2, k3, so that its calibrations can be used as they are.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class CameraModel:
    """Image size in pixels, focal lengths and principal point in pixels, distortion (k1, k2, p1, p2, k3)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    dist: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> Array:
        """The 3×3 camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def parameters(self) -> Array:
        """The nine parameters in the order of `PARAMETER_NAMES`."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.dist])

    def with_parameters(self, values: ArrayLike) -> Self:
        """The same sensor with other parameters, in the order of `PARAMETER_NAMES`."""
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(v) for v in np.asarray(values, dtype=np.float64))
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, dist=(k1, k2, p1, p2, k3))

    def as_dict(self) -> dict[str, object]:
        """For storage."""
        return {"width": self.width, "height": self.height, "parameters": self.parameters.tolist()}

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """From storage; KeyError, TypeError or ValueError when it is none."""
        sensor = cls(int(data["width"]), int(data["height"]), 1.0, fy=1.0, cx=0.0, cy=0.0)
        return sensor.with_parameters(data["parameters"])

    def project(self, points: ArrayLike) -> Array:
        """Pixels (n, 2) of points (n, 3) in the camera frame, in m; NaN for points that are not in front."""
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        z = np.where(p[:, 2] > 0, p[:, 2], np.nan)
        normalised = self.distort(p[:, :2] / z[:, None])
        return normalised * (self.fx, self.fy) + (self.cx, self.cy)

    def parameter_jacobian(self, points: ArrayLike) -> Array:
        """∂pixel/∂parameter (n, 2, 9) for points (n, 3) in front."""
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        x, y = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
        return self._by_parameters(x, y, self._distorted(x, y))

    def _by_parameters(self, x: Array, y: Array, distorted: Array) -> Array:
        xx, yy, twice_xy = x * x, y * y, 2 * x * y
        r2 = xx + yy
        made = np.zeros((len(x), 2, 9))
        made[:, 0, 0], made[:, 1, 1] = distorted[:, 0], distorted[:, 1]
        made[:, 0, 2] = made[:, 1, 3] = 1.0
        for axis, (f, a) in enumerate(((self.fx, x), (self.fy, y))):
            # Powers one after another: NumPy's take many times as long.
            by_k1 = f * a * r2
            by_k2 = by_k1 * r2
            made[:, axis, 4], made[:, axis, 5], made[:, axis, 8] = by_k1, by_k2, by_k2 * r2
        made[:, 0, 6], made[:, 1, 6] = self.fx * twice_xy, self.fy * (r2 + 2 * yy)
        made[:, 0, 7], made[:, 1, 7] = self.fx * (r2 + 2 * xx), self.fy * twice_xy
        return made

    def distort(self, normalised: ArrayLike) -> Array:
        """Distorted image coordinates (n, 2) of ideal ones (n, 2), both at unit distance."""
        xy = np.atleast_2d(np.asarray(normalised, dtype=np.float64))
        return self._distorted(xy[:, 0], xy[:, 1])

    def _distorted(self, x: Array, y: Array) -> Array:
        k1, k2, p1, p2, k3 = self.dist
        xx, yy, twice_xy = x * x, y * y, 2 * x * y
        r2 = xx + yy
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        made = np.empty((len(x), 2))
        made[:, 0] = x * radial + p1 * twice_xy + p2 * (r2 + 2 * xx)
        made[:, 1] = y * radial + p1 * (r2 + 2 * yy) + p2 * twice_xy
        return made

    def normalised(self, pixels: ArrayLike) -> Array:
        """Ideal image coordinates (n, 2) at unit distance of pixels (n, 2), by Newton's method on `distort`.

        NaN where the model has no inverse: a pixel beyond the fold of a strong distortion. Points beyond the fold, seen
        at such a pixel by the formula only, are none.
        """
        target = (np.atleast_2d(np.asarray(pixels, dtype=np.float64)) - (self.cx, self.cy)) / (self.fx, self.fy)
        if not any(self.dist):
            return target
        # Here, because that module needs this one.
        from cell.measure.geometry.board_projection import undistort

        found, off, determinant = np.empty((len(target), 2)), np.empty(len(target)), np.empty(len(target))
        undistort(self.parameters, np.ascontiguousarray(target), found, off, determinant)
        x, y = found.T
        r2 = x * x + y * y
        with np.errstate(invalid="ignore"):
            fold = self._fold(float(np.fmax.reduce(r2, initial=0.0)))
            found[~((off < 1e-9) & (determinant > 0) & (r2 < fold))] = np.nan
        return found

    def _fold(self, farthest: float) -> float:
        """Squared distance from the axis, at unit distance, where the picture folds: what is farther out is seen
        farther in. By the radial terms, infinite where they do not fold up to the squared distance `farthest`."""
        k1, k2, _, _, k3 = self.dist
        # With s the squared distance, the slope of the radius is 1 + 3 k1 s + 5 k2 s² + 7 k3 s³. Most lenses are far
        # from a fold, which costs less to see than to solve.
        least = 3 * min(k1, 0.0) + farthest * (5 * min(k2, 0.0) + farthest * 7 * min(k3, 0.0))
        if farthest * least > -1.0:
            return float("inf")
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
        folds = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        return float(folds.min(initial=np.inf))

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit rays (n, 3) in the camera frame through pixels (n, 2)."""
        xy = self.normalised(pixels)
        rays = np.column_stack([xy, np.ones(len(xy))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), dtype=np.float64)

    def rays_with_jacobian(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Unit rays (n, 3) and ∂ray/∂pixel (n, 3, 2) for pixels (n, 2)."""
        xy = self.normalised(pixels)
        direction = np.column_stack([xy, np.ones(len(xy))])
        length = np.linalg.norm(direction, axis=1)
        rays = direction / length[:, None]
        across = (np.eye(3) - rays[:, :, None] * rays[:, None, :]) / length[:, None, None]
        inverse = _inverse2(self._distortion_jacobian(xy[:, 0], xy[:, 1])) / np.array([self.fx, self.fy])
        return rays, np.asarray(across[:, :, :2] @ inverse, dtype=np.float64)

    def _distortion_jacobian(self, x: Array, y: Array) -> Array:
        k1, k2, p1, p2, k3 = self.dist
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
        jacobian = np.empty((len(x), 2, 2))
        jacobian[:, 0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
        jacobian[:, 1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        jacobian[:, 0, 1] = jacobian[:, 1, 0] = x * y * slope + 2 * p1 * x + 2 * p2 * y
        return jacobian


def _inverse2(m: Array) -> Array:
    determinant = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
    inverse = np.empty_like(m)
    inverse[:, 0, 0], inverse[:, 1, 1] = m[:, 1, 1], m[:, 0, 0]
    inverse[:, 0, 1], inverse[:, 1, 0] = -m[:, 0, 1], -m[:, 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(inverse / determinant[:, None, None], dtype=np.float64)


def seen_centres(centres: ArrayLike, normal: ArrayLike, radius: float) -> Array:
    """Points (n, 3) whose images are the centres of the ellipses of circles with `centres` (n, 3), all in m.

    The circles lie in planes with the unit `normal` (3,); everything is in the camera frame. The image of a circle
    has the dual conic c cᵀ − r²(I − n nᵀ); its last column is the ellipse's centre in homogeneous coordinates.
    """
    c = np.atleast_2d(np.asarray(centres, dtype=np.float64))
    n = np.asarray(normal, dtype=np.float64)
    seen = c * c[:, 2:3] + radius**2 * n * n[2]
    seen[:, 2] -= radius**2
    return np.asarray(seen / c[:, 2:3], dtype=np.float64)
