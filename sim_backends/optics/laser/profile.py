"""The light of one row crossing of the stripe, spread over pixels, and the speckle on it.

Radiometry, docs/explanation/theory.md, section 4: the irradiance of the light sheet falls with the distance from the
laser and the cosine of incidence; a diffuse surface's image does not depend on the camera's distance. Speckle is a
log-normal factor of mean 1 and standard deviation C, new in every frame. It moves a stripe's centre by about
0.6 C √(grain × stripe width) pixels, the error that no extractor can remove.
"""

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import gaussian, scramble, step_on_plane
from sim_backends.optics.compiled import compiled
from sim_backends.optics.pattern import albedo_at

Vector = NDArray[np.float64]
Image = NDArray[np.float32]

REFERENCE_RANGE = 0.130
"""Distance from the laser in m at which `LaserOptics.brightness` holds."""
NARROWEST = 0.05
"""Share of the facing value of |∂(distance to the light plane)/∂u| at which a grazing stripe stops widening."""


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
    return float(1.0 - tail if x >= 0 else tail - 1.0)


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
    image: Image, touched: NDArray[np.int64], rows: NDArray[np.int64], columns: Vector, slopes: Vector, points: Vector,
    normals: Vector, factors: Vector, intrinsics: Vector, camera: Vector, plane_normal: Vector, origin: Vector,
    sheet: float, brightness: float, pose: Vector, pattern: Vector,
) -> None:  # fmt: skip
    """Draw crossings of one object, each with a factor on its light.

    On a patterned board the sheet is cut into sub-sheets and sub-rows, each with the albedo under it, so that the
    edges of dots pull the stripe as they do in a real picture.
    """
    patterned = pattern[0] > 0
    width, height = image.shape[1], image.shape[0]
    sheets = 9 if patterned else 1
    sub_rows = 5 if patterned else 1
    corner = 1.0 / (0.25 * (width * width + height * height))
    for i in range(rows.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        mx, my, mz = normals[i, 0], normals[i, 1], normals[i, 2]
        gx, gy, gz = step_on_plane(points[i], normals[i], 1.0, 0.0, intrinsics)
        distance_per_px = plane_normal[0] * gx + plane_normal[1] * gy + plane_normal[2] * gz
        if not np.isfinite(distance_per_px):
            continue
        floor = NARROWEST * pz / intrinsics[0]
        if abs(distance_per_px) < floor:
            distance_per_px = floor if distance_per_px >= 0 else -floor
        geometric = sheet / abs(distance_per_px)
        lx, ly, lz = origin[0] - px, origin[1] - py, origin[2] - pz
        span = np.sqrt(lx * lx + ly * ly + lz * lz)
        incidence = abs(mx * lx + my * ly + mz * lz) / span
        a, b = columns[i] - 0.5 * (width - 1), rows[i] - 0.5 * (height - 1)
        light = (
            factors[i] * brightness * incidence * REFERENCE_RANGE / span * (1.0 - camera[5] * (a * a + b * b) * corner)
        )
        disc = camera[0] / camera[1] * camera[0] * abs(pz - camera[2]) / (pz * (camera[2] - camera[0])) / camera[3]
        lens = camera[4] * camera[4] + disc * disc / 16.0
        slope = min(max(slopes[i], -20.0), 20.0)
        # Along the stripe, one row further: the point on the plane seen at (u + slope, v + 1).
        sx, sy, sz = step_on_plane(points[i], normals[i], slope, 1.0, intrinsics)
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
                    qx = px + shift * gx + rise * sx - pose[0, 3]
                    qy = py + shift * gy + rise * sy - pose[1, 3]
                    qz = pz + shift * gz + rise * sz - pose[2, 3]
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


def add_speckled(
    image: Image, stripe: Image, touched: NDArray[np.int64], contrast: float, grain_px: float, rng: np.random.Generator
) -> None:
    """Add `stripe` times the speckle to `image`, row v in the columns touched[v, 0] … touched[v, 1] (excluded).

    `grain_px` is the standard deviation of the kernel that correlates white noise; the correlation of two pixels at
    distance r is then exp(−r²/4 grain²).
    """
    if contrast < 0 or grain_px <= 0:
        raise ValueError(f"speckle contrast {contrast}, grain {grain_px} px: contrast 0 or more, grain above 0 px")
    radius = max(1, int(np.ceil(3 * grain_px)))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / grain_px) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    spread = float(np.sqrt(np.log1p(contrast**2)))
    apply(image, stripe, touched, spread=spread, kernel=kernel, seed=rng.integers(0, 2**63, dtype=np.uint64))


@compiled
def apply(
    image: Image, stripe: Image, touched: NDArray[np.int64], spread: float, kernel: Vector, seed: np.uint64
) -> None:
    """Compiled core of `add_speckled`; white noise is a hash of the pixel, so that no field has to be stored."""
    height, width = stripe.shape
    size = kernel.shape[0]
    column = np.empty(width + size)
    for v in range(height):
        u0, u1 = touched[v, 0], touched[v, 1]
        if u1 <= u0:
            continue
        for u in range(u0, u1 + size - 1):
            mixed = 0.0
            for k in range(size):
                mixed += kernel[k] * gaussian(scramble(seed + np.uint64((v + k) * (width + size) + u)))
            column[u] = mixed
        for u in range(u0, u1):
            field = 0.0
            for k in range(size):
                field += kernel[k] * column[u + k]
            image[v, u] += stripe[v, u] * np.exp(spread * field - 0.5 * spread * spread)
