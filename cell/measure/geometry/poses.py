"""Poses as `pin.SE3`, their other spellings, how their covariances travel, and square roots of covariances.

A pose named `a_from_b` maps b-coordinates into a. Its 6×6 covariance is of (δt, δφ) in the axes of a: t → t + δt for
b's origin in m, R → exp(δφ) R in rad. Translation first, then rotation, everywhere in the cell.
"""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from cell.measure.geometry.camera import Array

NEGLIGIBLE = 1e-12
"""Of the correlations' eigenvalues; their sum is the number of parameters."""


def covariance_root(covariance: Array) -> Array:
    """Columns (n, m), m ≤ n, whose outer products sum to a covariance (n, n): one for each independent direction.

    Every parameter is taken in units of its own deviation: beside a focal length in px a hundredth of a millimetre in m
    would look like nothing, and be left out. Parameters without variance have zeros.
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > NEGLIGIBLE
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]), dtype=np.float64)


ROUNDING = 1e-14
"""What some twenty products of true rotations, such as the steps of an adjustment, leave of R Rᵀ − 1."""


def from_matrix(matrix: ArrayLike) -> pin.SE3:
    """Pose of a homogeneous 4×4 matrix; the rotation is brought back to the nearest true rotation. One that is true as
    far as doubles go stays as it is: a pose that was kept comes back to the last bit."""
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape != (4, 4) or not np.allclose(m[3], (0, 0, 0, 1), atol=1e-6):
        raise ValueError(f"a pose must be a 4×4 matrix with last row 0 0 0 1, not of shape {m.shape}: {m.tolist()}")
    u, s, vt = np.linalg.svd(m[:3, :3])
    if abs(s - 1).max() > 1e-2 or np.linalg.det(m[:3, :3]) < 0:
        raise ValueError(f"the upper left 3×3 of a pose must be a rotation; its singular values are {s.tolist()}")
    true = np.abs(m[:3, :3] @ m[:3, :3].T - np.eye(3)).max() < ROUNDING
    return pin.SE3(m[:3, :3].copy() if true else u @ vt, m[:3, 3].copy())


def from_parts(translation: ArrayLike, rotation: ArrayLike | None = None) -> pin.SE3:
    """Pose of a translation (3,) in m and a 3×3 rotation (none: identity)."""
    r = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    return pin.SE3(r, np.asarray(translation, dtype=np.float64).copy())


def from_ur(vector: ArrayLike) -> pin.SE3:
    """Pose of the arm controller's six numbers: x, y, z in m and a rotation vector in rad."""
    v = np.asarray(vector, dtype=np.float64)
    if v.shape != (6,):
        raise ValueError(f"an arm pose has 6 numbers (x, y, z, rx, ry, rz), not {v.size}")
    return pin.SE3(pin.exp3(v[3:]), v[:3].copy())


def to_ur(pose: pin.SE3) -> Array:
    """The arm controller's six numbers of a pose: x, y, z in m and a rotation vector in rad."""
    return np.concatenate([pose.translation, pin.log3(pose.rotation)])


def from_quaternion(translation: ArrayLike, xyzw: ArrayLike) -> pin.SE3:
    """Pose of a translation (3,) in m and a quaternion (x, y, z, w) of about unit length."""
    q = np.asarray(xyzw, dtype=np.float64)
    length = float(np.linalg.norm(q))
    if q.shape != (4,) or not 0.99 < length < 1.01:
        raise ValueError(f"a rotation needs a quaternion (x, y, z, w) of length 1, not {q.tolist()}")
    return from_parts(translation, pin.Quaternion(*(q[[3, 0, 1, 2]] / length)).toRotationMatrix())


def cross(a: Array, b: Array) -> Array:
    """Cross products along the last axis of length 3, with broadcasting; several times quicker than NumPy's."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    made = np.empty((*x.shape, 3))
    made[..., 0], made[..., 1], made[..., 2] = x, az * bx - ax * bz, ax * by - ay * bx
    return made


def transform(pose: pin.SE3, points: ArrayLike) -> Array:
    """Points (…, 3) of frame b in frame a, for `pose` = a_from_b."""
    p = np.asarray(points, dtype=np.float64)
    return np.asarray(p @ pose.rotation.T + pose.translation, dtype=np.float64)


def perturbed(pose: pin.SE3, delta: ArrayLike) -> pin.SE3:
    """The pose moved by (δt in m, δφ in rad), in the sense of the module's covariance."""
    d = np.asarray(delta, dtype=np.float64)
    return pin.SE3(pin.exp3(d[3:]) @ pose.rotation, pose.translation + d[:3])


def difference(pose: pin.SE3, reference: pin.SE3) -> Array:
    """The (δt, δφ) (6,) that `perturbed(reference, …)` needs to become `pose`."""
    return np.concatenate([pose.translation - reference.translation, pin.log3(pose.rotation @ reference.rotation.T)])


def mean(poses: Sequence[pin.SE3]) -> pin.SE3:
    """Mean of poses that lie near each other: arithmetic for the translation, on the rotation group otherwise."""
    if not poses:
        raise ValueError("the mean of no poses does not exist: give at least one")
    rotation = poses[0].rotation.copy()
    for _ in range(20):
        step = np.mean([pin.log3(p.rotation @ rotation.T) for p in poses], axis=0)
        rotation = pin.exp3(step) @ rotation
        if np.linalg.norm(step) < 1e-14:
            break
    return pin.SE3(rotation, np.mean([p.translation for p in poses], axis=0))


def compose_covariance(a_from_b: pin.SE3, cov_ab: ArrayLike, b_from_c: pin.SE3, cov_bc: ArrayLike) -> Array:
    """6×6 covariance of a_from_c = a_from_b · b_from_c, in the axes of a, of two independent poses."""
    outer, inner = composition_jacobians(a_from_b, b_from_c)
    first, second = np.asarray(cov_ab, dtype=np.float64), np.asarray(cov_bc, dtype=np.float64)
    return np.asarray(outer @ first @ outer.T + inner @ second @ inner.T, dtype=np.float64)


def composition_jacobians(a_from_b: pin.SE3, b_from_c: pin.SE3) -> tuple[Array, Array]:
    """∂(a_from_c)/∂(a_from_b) and ∂(a_from_c)/∂(b_from_c), each 6×6, in the module's perturbations."""
    outer = np.eye(6)
    outer[:3, 3:] = -pin.skew(a_from_b.rotation @ b_from_c.translation)
    inner = np.zeros((6, 6))
    inner[:3, :3] = inner[3:, 3:] = a_from_b.rotation
    return outer, inner


def angle_apart(a_flange: pin.SE3, a_board: pin.SE3, b_flange: pin.SE3, b_board: pin.SE3) -> float:
    """Difference in rad between the angles of the flange's and the board's turn."""
    hand = float(np.linalg.norm(pin.log3(a_flange.rotation.T @ b_flange.rotation)))
    eye = float(np.linalg.norm(pin.log3(a_board.rotation @ b_board.rotation.T)))
    return abs(hand - eye)
