"""Where a board's points are seen, with derivatives, compiled point by point: calibrations come here most of all.

The formulas are those of `camera` and `circles`, which take arrays and also go backwards. A lens is the nine numbers of
`CameraModel.parameters`; lengths are in m, pixels in px.
"""

import numpy as np

from cell.base.compiled import compiled
from cell.measure.geometry.camera import Array

UNDISTORT_STEPS = 20
UNDISTORT_TOLERANCE = 1e-13


@compiled
def distorted(lens: Array, x: float, y: float) -> tuple[float, float, float, float, float]:  # pragma: no cover
    """Distorted coordinates of ideal ones, and the derivatives: of the first by x, of both by the other's, by y."""
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    return (
        x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx),
        y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy,
        radial + xx * slope + 2 * p1 * y + 6 * p2 * x,
        xy * slope + 2 * p1 * x + 2 * p2 * y,
        radial + yy * slope + 6 * p1 * y + 2 * p2 * x,
    )


@compiled
def undistort(lens: Array, distant: Array, ideal: Array, off: Array, determinant: Array) -> None:  # pragma: no cover
    """Newton's method on `distorted`: writes the `ideal` coordinates (n, 2) of distorted ones (n, 2). And by how much
    each is `off` (n,) still, and the `determinant` (n,) of the last step: not positive past a fold."""
    for i in range(len(distant)):
        x, y = distant[i, 0], distant[i, 1]
        determinant[i] = 1.0
        for _ in range(UNDISTORT_STEPS):
            u, v, by_x, both, by_y = distorted(lens, x, y)
            off_x, off_y = u - distant[i, 0], v - distant[i, 1]
            off[i] = max(abs(off_x), abs(off_y))
            if not off[i] >= UNDISTORT_TOLERANCE:
                break
            determinant[i] = by_x * by_y - both * both
            x -= (by_y * off_x - both * off_y) / determinant[i]
            y -= (by_x * off_y - both * off_x) / determinant[i]
        ideal[i, 0], ideal[i, 1] = x, y


@compiled
def lens_shift(
    lens: Array, x: float, y: float, nx: float, ny: float, nz: float, size: float
) -> tuple[float, float]:  # pragma: no cover
    """What the lens adds in px to the seen centre of a circle at the ideal coordinates x, y, with the unit normal n.

    `size` is its radius over its distance along the axis. Distortion bends an ellipse: the middle of its area moves by
    ½ tr(H C) + J C ∇ln|J|, with the distortion's Jacobian J and second derivatives H, and the second moments C of the
    undistorted ellipse. A dot of 30 px radius seen with k1 = −.2 is moved by .01 px, in one direction all over the
    picture's rim, which is felt in the board's distance.
    """
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    across, along = nx - x * nz, ny - y * nz
    moment = 0.25 * size * size
    cxx = moment * (1 + x * x - across * across)
    cxy = moment * (x * y - across * along)
    cyy = moment * (1 + y * y - along * along)
    r2 = x * x + y * y
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    bend = 4 * (2 * k2 + 6 * k3 * r2)
    # Radial and tangential terms are the gradient of one function: all these derivatives are symmetric.
    _, _, jxx, jxy, jyy = distorted(lens, x, y)
    hxxx, hxxy = 3 * x * slope + x * x * x * bend + 6 * p2, y * slope + x * x * y * bend + 2 * p1
    hxyy, hyyy = x * slope + x * y * y * bend + 2 * p2, 3 * y * slope + y * y * y * bend + 6 * p1
    area = jxx * jyy - jxy * jxy
    gx = (hxxx * jyy + jxx * hxyy - 2 * jxy * hxxy) / area
    gy = (hxxy * jyy + jxx * hyyy - 2 * jxy * hxyy) / area
    tx, ty = cxx * gx + cxy * gy, cxy * gx + cyy * gy
    return (
        lens[0] * (0.5 * (hxxx * cxx + hxyy * cyy) + hxxy * cxy + jxx * tx + jxy * ty),
        lens[1] * (0.5 * (hxxy * cxx + hyyy * cyy) + hxyy * cxy + jxy * tx + jyy * ty),
    )


@compiled
def seen_points(
    lens: Array, rotation: Array, translation: Array, points: Array, radius: float, pixels: Array
) -> None:  # pragma: no cover
    """Writes the pixels (n, 2) at which board points (n, 3) are measured; NaN for what is not in front.

    `rotation` (3, 3) and `translation` (3,) take the board's frame into the camera's. With a `radius` the points are
    circles of the board's plane, measured at the middle of their pictures.
    """
    nx, ny, nz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    for i in range(len(points)):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        px = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c + translation[0]
        py = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c + translation[1]
        pz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c + translation[2]
        share = radius * radius / pz if radius > 0 else 0.0
        z = pz + share * (nz * nz - 1)
        if not z > 0:
            pixels[i, 0] = pixels[i, 1] = np.nan
            continue
        u, v, _, _, _ = distorted(lens, (px + share * nx * nz) / z, (py + share * ny * nz) / z)
        pixels[i, 0], pixels[i, 1] = lens[0] * u + lens[2], lens[1] * v + lens[3]
        if radius > 0:
            right, down = lens_shift(lens, px / pz, py / pz, nx=nx, ny=ny, nz=nz, size=radius / pz)
            pixels[i, 0] += right
            pixels[i, 1] += down


@compiled
def pose_equations(
    lens: Array, rotation: Array, translation: Array, points: Array, factor: Array, residual: Array, normal: Array,
    right: Array,
) -> None:  # pragma: no cover  # fmt: skip
    """Writes the normal matrix (6, 6) and the right side (6,) for a small move of a board's pose in the camera. From
    `residual` (n, 2) in px, each point's weighted by `factor` (n,) squared. The move is (δt, δφ) in camera axes."""
    normal[:] = 0.0
    right[:] = 0.0
    row = np.zeros(6)
    for i in range(len(points)):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        ax = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
        ay = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
        az = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
        z = az + translation[2]
        x, y = (ax + translation[0]) / z, (ay + translation[1]) / z
        _, _, jxx, jxy, jyy = distorted(lens, x, y)
        for axis in range(2):
            size = factor[i] * lens[axis] / z
            row[0], row[1] = (size * jxx, size * jxy) if axis == 0 else (size * jxy, size * jyy)
            row[2] = -(row[0] * x + row[1] * y)
            row[3] = ay * row[2] - az * row[1]
            row[4] = az * row[0] - ax * row[2]
            row[5] = ax * row[1] - ay * row[0]
            off = factor[i] * residual[i, axis]
            for k in range(6):
                right[k] += row[k] * off
                for m in range(k + 1):
                    normal[k, m] += row[k] * row[m]
    for k in range(6):
        for m in range(k):
            normal[m, k] = normal[k, m]


@compiled
def _lens_columns(lens: Array, axis: int, x: float, y: float, seen: float, row: Array) -> None:  # pragma: no cover
    """Writes the derivatives of a pixel's coordinate by the nine terms of the lens; `seen` is it at unit distance."""
    f, along = lens[axis], x if axis == 0 else y
    xx, yy, twice_xy = x * x, y * y, 2 * x * y
    r2 = xx + yy
    row[axis] = seen
    row[2 + axis] = 1.0
    row[4] = f * along * r2
    row[5] = row[4] * r2
    row[8] = row[5] * r2
    row[6], row[7] = (f * twice_xy, f * (r2 + 2 * xx)) if axis == 0 else (f * (r2 + 2 * yy), f * twice_xy)


@compiled
def _add_tilt(tilted: Array, normal: tuple[float, float, float], flange: Array, row: Array) -> None:  # pragma: no cover
    """Adds what turning a circle of that `normal` does to its ellipse's centre, which moves by `tilted` (3,)."""
    bx, by, bz = normal
    about = (tilted[1] * bz - tilted[2] * by, tilted[2] * bx - tilted[0] * bz, tilted[0] * by - tilted[1] * bx)
    for k in range(3):
        row[18 + k] += about[0] * flange[0, k] + about[1] * flange[1, k] + about[2] * flange[2, k]
        row[24 + k] -= about[k]
        row[30 + k] += about[k]


@compiled
def dots_terms(
    lens: Array, board: Array, flange: Array, hand: Array, places: Array, rail: float, travel: Array, points: Array,
    radius: float, pixels: Array, jacobian: Array,
) -> None:  # pragma: no cover  # fmt: skip
    """Writes the pixels (n, 2) of a calibration view's points (n, 3) and their derivatives (n, 2, 34).

    `board`, `flange` and `hand` are the rotations (3, 3) of base_from_board, base_from_flange and flange_from_camera,
    `places` (3, 3) has their translations as rows; `travel` (3,) is the camera's way per metre of `rail`. The columns
    are those of `cell.measure.calibration.solve.normal`. A circle of `radius` is seen at its ellipse's centre.
    """
    to_camera = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                to_camera[i, j] += flange[j, k] * hand[k, i]
    bx, by, bz = board[0, 2], board[1, 2], board[2, 2]
    n = np.zeros(3)
    for i in range(3):
        n[i] = to_camera[i, 0] * bx + to_camera[i, 1] * by + to_camera[i, 2] * bz
    turned, away, from_camera, seen, mid = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    base, axes, tilted = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(len(points)):
        for k in range(3):
            turned[k] = board[k, 0] * points[i, 0] + board[k, 1] * points[i, 1] + board[k, 2] * points[i, 2]
            away[k] = turned[k] + places[0, k] - places[1, k]
        for k in range(3):
            from_camera[k] = flange[0, k] * away[0] + flange[1, k] * away[1] + flange[2, k] * away[2] - places[2, k]
        for k in range(3):
            seen[k] = hand[0, k] * from_camera[0] + hand[1, k] * from_camera[1] + hand[2, k] * from_camera[2]
            seen[k] -= rail * travel[k]
        share = radius * radius / seen[2]
        aside = (n[0] * n[2], n[1] * n[2], n[2] * n[2] - 1.0)
        for k in range(3):
            mid[k] = seen[k] + share * aside[k]
        x, y = mid[0] / mid[2], mid[1] / mid[2]
        u, v, jxx, jxy, jyy = distorted(lens, x, y)
        pixels[i, 0], pixels[i, 1] = lens[0] * u + lens[2], lens[1] * v + lens[3]
        for axis in range(2):
            row = jacobian[i, axis]
            row[:] = 0.0
            f = lens[axis]
            _lens_columns(lens, axis, x=x, y=y, seen=(u, v)[axis], row=row)
            by_x, by_y = f * (jxx, jxy)[axis] / mid[2], f * (jxy, jyy)[axis] / mid[2]
            by_z = -(by_x * x + by_y * y)
            # Farther away the circle is smaller, and its ellipse's centre nearer to the picture of its own.
            nearer = (by_x * aside[0] + by_y * aside[1] + by_z * aside[2]) * share / seen[2]
            point = (by_x, by_y, by_z - nearer)
            for k in range(3):
                base[k] = point[0] * to_camera[0, k] + point[1] * to_camera[1, k] + point[2] * to_camera[2, k]
                axes[k] = point[0] * hand[k, 0] + point[1] * hand[k, 1] + point[2] * hand[k, 2]
                row[12 + k] = -rail * point[k]
                row[15 + k] = -axes[k]
                row[21 + k] = base[k]
                row[27 + k] = -base[k]
            row[33] = -(point[0] * travel[0] + point[1] * travel[1] + point[2] * travel[2])
            for k in range(3):
                p, q = (k + 1) % 3, (k + 2) % 3
                row[18 + k] = axes[p] * from_camera[q] - axes[q] * from_camera[p]
                row[24 + k] = turned[p] * base[q] - turned[q] * base[p]
                row[30 + k] = base[p] * away[q] - base[q] * away[p]
            if radius > 0:
                # An ellipse's centre moves with the circle's tilt too. It is little, but a turn of the camera and a
                # shift of its principal point are told apart by as little.
                sideways = share * (by_x * n[0] + by_y * n[1] + by_z * n[2])
                tx, ty, tz = share * n[2] * by_x, share * n[2] * by_y, share * n[2] * by_z + sideways
                for k in range(3):
                    tilted[k] = tx * to_camera[0, k] + ty * to_camera[1, k] + tz * to_camera[2, k]
                _add_tilt(tilted, (bx, by, bz), flange, row)
