"""Kinematics of a six-axis arm from its Denavit-Hartenberg table, and where its flange truly is.

Angles are in rad, lengths in m. A pose is a (4, 4) matrix `base_from_flange` or the controller's 6-vector (x, y, z, rx,
ry, rz) with a rotation vector. Sources: the maker's DH table (docs/reference/protocols.md, section 1); damped least
squares after Nakamura and Hanafusa 1986.

A strain wave gear repeats its error once and twice a turn of the motor, which turns some hundred times as often as the
joint: over the whole workspace it looks like noise, and yet is the same wherever a joint comes back.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backends.clock import History

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


def _table(d1: float, a2: float, a3: float, d4: float, d5: float, d6: float) -> Matrix:
    half = 0.5 * math.pi
    rows = ((0.0, d1, half), (a2, 0.0, 0.0), (a3, 0.0, 0.0), (0.0, d4, half), (0.0, d5, -half), (0.0, d6, 0.0))
    return np.array([(*row, 0.0) for row in rows])


UR10E_DH = _table(0.1807, -0.6127, -0.57155, d4=0.17415, d5=0.11985, d6=0.11655)
"""One row per joint: a in m, d in m, alpha in rad, joint offset in rad."""
UR5E_DH = _table(0.1625, -0.425, -0.3922, d4=0.1333, d5=0.0997, d6=0.0996)
TABLES: dict[str, Matrix] = {
    "UR3": _table(0.1519, -0.24365, -0.21325, d4=0.11235, d5=0.08535, d6=0.0819),
    "UR5": _table(0.089159, -0.425, -0.39225, d4=0.10915, d5=0.09465, d6=0.0823),
    "UR10": _table(0.1273, -0.612, -0.5723, d4=0.163941, d5=0.1157, d6=0.0922),
    "UR3e": _table(0.15185, -0.24355, -0.2132, d4=0.13105, d5=0.08535, d6=0.0921),
    "UR5e": UR5E_DH,
    "UR7e": UR5E_DH,
    "UR10e": UR10E_DH,
    "UR12e": UR10E_DH,
    "UR16e": _table(0.1807, -0.4784, -0.36, d4=0.17415, d5=0.11985, d6=0.11655),
    "UR20": _table(0.2363, -0.862, -0.7287, d4=0.201, d5=0.1593, d6=0.1543),
    "UR30": _table(0.2363, -0.637, -0.5037, d4=0.201, d5=0.1593, d6=0.1543),
}
"""The maker's table by the name of the model."""

_Frame = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""Axes x, y, z and origin of a frame, three numbers each."""
_BASE: _Frame = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_EYE = np.eye(6)
_MAX_STEP = 0.5
_RESTARTS = np.vstack((np.zeros(6), np.random.default_rng(0).uniform(-2.0, 2.0, (15, 6))))
"""Where the inverse begins, relative to the wanted neighbourhood, until one descent arrives."""


class Kinematics:
    """Forward and inverse kinematics of one DH table of shape (6, 4): columns a, d, alpha, joint offset."""

    def __init__(self, table: Matrix) -> None:
        if table.shape != (6, 4) or not np.all(np.isfinite(table)):
            raise ValueError(f"a DH table needs finite numbers in shape (6, 4), got shape {table.shape}")
        self._links = [(a, d, math.cos(alpha), math.sin(alpha), offset) for a, d, alpha, offset in table.tolist()]

    def forward(self, q: Vector) -> Matrix:
        """base_from_flange (4, 4) at joint angles `q` (6,)."""
        return _matrix(self._chain(q)[-1])

    def frames(self, q: Vector) -> Matrix:
        """The frames (7, 4, 4) of the base and of the six links in the base at joint angles `q` (6,)."""
        return np.array([_matrix(frame) for frame in self._chain(q)])

    def forward_with_jacobian(self, q: Vector) -> tuple[Matrix, Matrix]:
        """base_from_flange (4, 4) and the Jacobian (6, 6) of flange velocity and rotation rate in base axes."""
        frames = self._chain(q)
        flange = frames[-1]
        px, py, pz = flange[9:]
        rows = []
        for frame in frames[:-1]:
            zx, zy, zz = frame[6:9]
            x, y, z = px - frame[9], py - frame[10], pz - frame[11]
            rows.append((zy * z - zz * y, zz * x - zx * z, zx * y - zy * x, zx, zy, zz))
        return _matrix(flange), np.array(rows).T

    def inverse(
        self, target: Matrix, near: Vector, limit: float = 2 * math.pi, tolerance: float = 1e-9
    ) -> Vector | None:
        """Joint angles (6,) within ±`limit` that reach `target` (4, 4), next to `near`; None without any. `tolerance`
        bounds the remaining position error in m and rotation error in rad."""
        for offset in _RESTARTS:
            q = self._descend(target, near + offset, tolerance)
            if q is not None:
                q = near + np.mod(q - near + math.pi, 2 * math.pi) - math.pi
                return np.where(q > limit, q - 2 * math.pi, np.where(q < -limit, q + 2 * math.pi, q))
        return None

    def refine(self, target: Matrix, q: Vector) -> Vector | None:
        """Joint angles (6,) for a `target` (4, 4) close to where `q` stands, without leaving its branch; else None."""
        return self._descend(target, q, 1e-9, iterations=8)

    def _descend(self, target: Matrix, q: Vector, tolerance: float, iterations: int = 60) -> Vector | None:
        milestone = math.inf
        for i in range(iterations):
            pose, jacobian = self.forward_with_jacobian(q)
            error = pose_error(target, pose)
            size = max(map(abs, error.tolist()))
            if size < tolerance:
                return q
            if i % 12 == 11:
                if size > 0.7 * milestone:
                    return None
                milestone = size
            # Damping that fades with the error converges quadratically and yet passes singularities.
            damping = 1e-3 * size + 1e-12
            step = jacobian.T.dot(np.linalg.solve(jacobian.dot(jacobian.T) + damping * _EYE, error))
            longest = max(map(abs, step.tolist()))
            q = q + step * min(1.0, _MAX_STEP / longest) if longest > 0 else q
        return None

    def _chain(self, q: Vector) -> list[_Frame]:
        """Axes and origins of the base and the six link frames. Plain floats: on matrices this small they are several
        times faster than arrays, and the arm's tick rests on it."""
        frames = [_BASE]
        x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = _BASE
        for angle, (a, d, ca, sa, offset) in zip(q.tolist(), self._links, strict=True):
            c, s = math.cos(angle + offset), math.sin(angle + offset)
            p0, p1, p2 = p0 + d * z0, p1 + d * z1, p2 + d * z2
            n0, n1, n2 = c * y0 - s * x0, c * y1 - s * x1, c * y2 - s * x2
            x0, x1, x2 = c * x0 + s * y0, c * x1 + s * y1, c * x2 + s * y2
            p0, p1, p2 = p0 + a * x0, p1 + a * x1, p2 + a * x2
            y0, y1, y2 = ca * n0 + sa * z0, ca * n1 + sa * z1, ca * n2 + sa * z2
            z0, z1, z2 = ca * z0 - sa * n0, ca * z1 - sa * n1, ca * z2 - sa * n2
            frames.append((x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2))
        return frames


def _matrix(frame: _Frame) -> Matrix:
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = frame
    return np.array(((x0, y0, z0, p0), (x1, y1, z1, p1), (x2, y2, z2, p2), (0.0, 0.0, 0.0, 1.0)))


def pose_error(target: Matrix, pose: Matrix) -> Vector:
    """Translation and rotation vector (6,), in base axes, that carry `pose` (4, 4) onto `target` (4, 4)."""
    error = np.empty(6)
    error[:3] = target[:3, 3] - pose[:3, 3]
    error[3:] = rotation_vector(target[:3, :3].dot(pose[:3, :3].T))
    return error


def rotation_vector(rotation: Matrix) -> Vector:
    """Rotation vector (3,) in rad of a rotation matrix (3, 3); well behaved up to and at half a turn."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation.tolist()
    # Shepperd's choice of the largest quaternion component keeps the division away from zero.
    trace = r00 + r11 + r22
    if trace > 0.0:
        w, x, y, z = 1.0 + trace, r21 - r12, r02 - r20, r10 - r01
    elif r00 >= r11 and r00 >= r22:
        w, x, y, z = r21 - r12, 1.0 + r00 - r11 - r22, r01 + r10, r02 + r20
    elif r11 >= r22:
        w, x, y, z = r02 - r20, r01 + r10, 1.0 + r11 - r00 - r22, r12 + r21
    else:
        w, x, y, z = r10 - r01, r02 + r20, r12 + r21, 1.0 + r22 - r00 - r11
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-300 else 0.0
    return np.array([x * scale, y * scale, z * scale])


def rotation_matrix(vector: Iterable[float]) -> Matrix:
    """Rotation matrix (3, 3) of a rotation vector (3,) in rad (Rodrigues)."""
    x, y, z = (float(v) for v in vector)
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-8:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    c = 1.0 - b * angle * angle
    return np.array(
        [
            [c + b * x * x, b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, c + b * y * y, b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, c + b * z * z],
        ]
    )


def matrix_from_pose(pose: Vector) -> Matrix:
    """(4, 4) matrix of the controller's 6-vector (x, y, z, rx, ry, rz)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(pose[3:])
    matrix[:3, 3] = pose[:3]
    return matrix


def pose_from_matrix(matrix: Matrix) -> Vector:
    """The controller's 6-vector (x, y, z, rx, ry, rz) of a (4, 4) matrix."""
    return np.concatenate((matrix[:3, 3], rotation_vector(matrix[:3, :3])))


def invert(matrix: Matrix) -> Matrix:
    """Inverse of a rigid (4, 4) transformation."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T.dot(matrix[:3, 3])
    return inverse


GRAVITY = 9.81
GEAR_RATIO = 101.0


@dataclass(frozen=True, eq=False)
class JointErrors:
    """`harmonics` (6, 4): sine and cosine of one turn of the motor, then of two, rad; `compliance` in rad/(N m). The
    flange carries `mass` kg at its origin."""

    kinematics: Kinematics
    harmonics: Matrix
    compliance: float = 0.0
    mass: float = 0.0

    def true(self, q: Vector) -> Vector:
        """The angles (6,), rad, at which the joints truly stand when their encoders read `q` (6,)."""
        h, motor = self.harmonics, GEAR_RATIO * q
        off = h[:, 0] * np.sin(motor) + h[:, 1] * np.cos(motor)
        off = off + h[:, 2] * np.sin(2.0 * motor) + h[:, 3] * np.cos(2.0 * motor)
        if self.compliance > 0.0:
            _, jacobian = self.kinematics.forward_with_jacobian(q)
            off = off - (self.compliance * self.mass * GRAVITY) * jacobian[2]
        return np.asarray(q + off)


class TruePose:
    """True base_from_flange over time of an arm with `kinematics`; errors per axis `sigma` in m and rad."""

    def __init__(
        self, kinematics: Kinematics, sigma: tuple[float, float], blend_time: float, rng: np.random.Generator,
        joints: JointErrors | None = None, memory: float = 0.0,
    ) -> None:  # fmt: skip
        """`blend_time` is how many seconds of motion the error takes to become the next one; with a `memory`, rad, it
        changes with the joints' way instead, and is another one after about that way."""
        self.pose: Matrix = np.eye(4)
        self._kinematics = kinematics
        self._sigma = np.repeat(sigma, 3)
        self._blend_time = blend_time
        self._rng = rng
        self._from = self._to = self._error = self._draw()
        self._turn = rotation_matrix(self._error[3:])
        self._blend = 1.0
        self._resting = True
        self._joints = joints
        self._memory = memory
        self._q: Vector | None = None
        self._history = History()

    def update(self, t: float, dt: float, q: Vector, moving: bool) -> None:
        """Follow the joints `q` (6,) to world time `t`, `dt` after the last call, and remember the pose."""
        if moving and self._memory > 0.0:
            self._drift(q)
        elif moving:
            self._wander(dt)
        self._resting = not moving
        self.look(q)
        self._history.append(t, self.pose)

    def look(self, q: Vector) -> Matrix:
        """The true pose (4, 4) at joint angles `q` with the error of this moment; not remembered."""
        if self._q is not q:
            pose = self._kinematics.forward(q if self._joints is None else self._joints.true(q))
            pose[:3, 3] += self._error[:3]
            pose[:3, :3] = self._turn.dot(pose[:3, :3])
            self.pose, self._q = pose, q
        return self.pose

    def at(self, t: float) -> Matrix:
        """The true pose (4, 4) at world time `t`."""
        return self._history.at(t)

    def _draw(self) -> Vector:
        error: Vector = self._rng.normal(size=6) * self._sigma
        return error

    def _drift(self, q: Vector) -> None:
        """A first-order process over the joints' way, with the same variance everywhere."""
        way = 0.0 if self._q is None else float(np.linalg.norm(q - self._q))
        if way > 0.0:
            kept = math.exp(-way / self._memory)
            self._error = kept * self._error + math.sqrt(1.0 - kept * kept) * self._draw()
            self._turn = rotation_matrix(self._error[3:])
            self._q = None

    def _wander(self, dt: float) -> None:
        if self._resting:
            self._from, self._to, self._blend = self._error, self._draw(), 0.0
        if self._blend < 1.0:
            self._blend = min(1.0, self._blend + dt / self._blend_time)
            angle = 0.5 * math.pi * self._blend
            self._error = math.cos(angle) * self._from + math.sin(angle) * self._to
            self._turn = rotation_matrix(self._error[3:])
            self._q = None
