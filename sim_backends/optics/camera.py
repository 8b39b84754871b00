"""Pin-hole camera with Brown distortion, thin-lens defocus, mild vignetting, and an 8-bit sensor with its noise.

Camera frame: z along the optical axis, x to the right, y down the image; metres. Pixel centres lie at whole numbers.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled, compiled_fast

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
    """How a point (3,) on its tangent plane of this normal (3,) moves, m, as its picture moves by (du, dv) px. Not
    finite where the plane is seen edge on."""
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


Image = NDArray[np.float32]


def blur_window(image: Image, window: tuple[int, int, int, int], sigma: float) -> None:
    """Blur `image` inside the window (u0, v0, u1, v1, ends excluded) by `sigma` pixels; edges are repeated."""
    u0, v0, u1, v1 = window
    radius = 3 * max(1, int(np.ceil(3.5 * sigma / 3)))
    if u1 <= u0 or v1 <= v0 or sigma < 0.05:
        return
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    # The compiler makes fast code for contiguous arrays only.
    part = np.ascontiguousarray(image[v0:v1, u0:u1])
    separable_blur(part, (kernel / kernel.sum()).astype(np.float32))
    image[v0:v1, u0:u1] = part


@compiled_fast
def separable_blur(image: Image, kernel: Image) -> None:
    """Convolve with the symmetric `kernel` along both axes, repeating edge pixels; its radius is a multiple of 3."""
    rows, cols = image.shape
    radius = kernel.shape[0] // 2
    across = np.empty((rows, cols), dtype=np.float32)
    line = np.empty(cols + 2 * radius, dtype=np.float32)
    for v in range(rows):
        for u in range(line.shape[0]):
            line[u] = image[v, min(max(u - radius, 0), cols - 1)]
        out = across[v]
        scale(out, line[radius : radius + cols], kernel[radius])
        for k in range(0, radius, 3):
            far = 2 * radius - k
            add_pairs(
                out, kernel[k : k + 3], line[k : k + cols], b=line[far : far + cols], c=line[k + 1 : k + 1 + cols],
                d=line[far - 1 : far - 1 + cols], e=line[k + 2 : k + 2 + cols], f=line[far - 2 : far - 2 + cols],
            )  # fmt: skip
    for v in range(rows):
        out = image[v]
        scale(out, across[v], kernel[radius])
        for k in range(0, radius, 3):
            reach = radius - k
            add_pairs(
                out, kernel[k : k + 3], across[max(0, v - reach)], b=across[min(rows - 1, v + reach)],
                c=across[max(0, v - reach + 1)], d=across[min(rows - 1, v + reach - 1)],
                e=across[max(0, v - reach + 2)], f=across[min(rows - 1, v + reach - 2)],
            )  # fmt: skip


@compiled_fast
def scale(out: Image, line: Image, weight: np.float32) -> None:
    """Set `out` to `weight` times `line`."""
    for u in range(out.shape[0]):
        out[u] = weight * line[u]


@compiled_fast
def add_pairs(out: Image, weights: Image, a: Image, b: Image, c: Image, d: Image, e: Image, f: Image) -> None:
    """Add the weighted pairs (a, b), (c, d), (e, f) to `out`."""
    p, q, r = weights[0], weights[1], weights[2]
    for u in range(out.shape[0]):
        out[u] += p * (a[u] + b[u]) + q * (c[u] + d[u]) + r * (e[u] + f[u])


def sensor(image_dn: Image, optics: CameraOptics, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Expose: `image_dn` (height, width) expected DN → uint8 picture.

    Variance in DN² = DN / (electrons per DN) + read noise², drawn as a Gaussian (docs/explanation/theory.md, section
    4); the same state of `rng` gives the same picture.
    """
    picture = np.empty(image_dn.shape, dtype=np.uint8)
    seed = rng.integers(0, 2**63, dtype=np.uint64)
    quantise(
        np.ascontiguousarray(image_dn, dtype=np.float32).ravel(), np.float32(1.0 / optics.electrons_per_dn),
        np.float32(optics.read_noise_dn**2), seed, picture.ravel(),
    )  # fmt: skip
    return picture


@compiled_fast
def scramble(counter: np.uint64) -> np.uint64:
    """Splitmix64's finaliser: 64 random bits of a counter."""
    z = counter * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled_fast
def gaussian(bits: np.uint64) -> np.float32:
    """Standard normal number as the sum of the eight bytes of `bits` (within ±4.8, kurtosis −0.15)."""
    mask = np.uint64(0x00FF00FF00FF00FF)
    pairs = (bits & mask) + ((bits >> np.uint64(8)) & mask)
    total = (pairs * np.uint64(0x0001000100010001)) >> np.uint64(48)
    return (np.float32(np.int64(total)) - np.float32(1020.0)) * np.float32(0.0047841)


@compiled_fast
def quantise(
    light: Image, gain: np.float32, read_variance: np.float32, seed: np.uint64, picture: NDArray[np.uint8]
) -> None:
    """Compiled core of `sensor` on flat arrays."""
    for i in range(light.shape[0]):
        level = max(light[i], np.float32(0.0))
        noise = np.sqrt(level * gain + read_variance) * gaussian(scramble(seed + np.uint64(i)))
        picture[i] = np.uint8(min(max(level + noise + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))
