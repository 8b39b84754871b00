"""What an arm's joints are off: angles that its encoders do not see, from uneven gears and from the weight it carries.

A strain wave gear repeats its error once and twice a turn of the motor, which turns some hundred times as often as the
joint: over the whole workspace it looks like noise, and yet is the same wherever a joint comes back. Under a weight
each joint gives way by its compliance times the torque about its axis; gravity is along the base's -z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim_backends.models.arm_kinematics import Kinematics, Matrix, Vector

GRAVITY = 9.81
GEAR_RATIO = 101.0


@dataclass(frozen=True, eq=False)
class JointErrors:
    """`harmonics` (6, 4): sine and cosine of one turn of the motor, then of two, rad; `compliance` in rad/(N m).

    The flange carries `mass` kg at its origin.
    """

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
