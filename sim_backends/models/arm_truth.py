"""Where the flange truly is: the true kinematics at the encoders' joint angles, and an error of repeatability.

The error is drawn anew for every rest. While the arm moves, it passes smoothly from the last rest's error to the next
one's, and its variance stays the same on the way. Or, with a memory, it is another one only after some way of the
joints: a place approached again in the same manner has the same error. What the joints are off is in `arm_joints`.
"""

from __future__ import annotations

import math

import numpy as np

from sim_backends.history import History
from sim_backends.models.arm_joints import JointErrors
from sim_backends.models.arm_kinematics import Kinematics, Matrix, Vector, rotation_matrix


class TruePose:
    """True base_from_flange over time of an arm with `kinematics`; errors per axis `sigma` in m and rad."""

    def __init__(
        self,
        kinematics: Kinematics,
        sigma: tuple[float, float],
        blend_time: float,
        rng: np.random.Generator,
        joints: JointErrors | None = None,
        memory: float = 0.0,
    ) -> None:
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
