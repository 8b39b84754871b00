"""What an arm's joints are off: angles that its encoders do not see, from uneven gears and from the weight it carries.

Gears and ring encoders repeat once and twice a turn of the joint. Under a weight each joint gives way by its compliance
times the torque about its axis; gravity is along the base's -z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim_backends.models.arm_kinematics import Kinematics, Matrix, Vector

GRAVITY = 9.81


@dataclass(frozen=True, eq=False)
class JointErrors:
    """`harmonics` (6, 4): sine and cosine of one turn, then of two, rad; `compliance` of each joint in rad/(N m).

    The flange carries `mass` kg at its origin.
    """

    kinematics: Kinematics
    harmonics: Matrix
    compliance: float = 0.0
    mass: float = 0.0

    def true(self, q: Vector) -> Vector:
        """The angles (6,), rad, at which the joints truly stand when their encoders read `q` (6,)."""
        h = self.harmonics
        off = h[:, 0] * np.sin(q) + h[:, 1] * np.cos(q) + h[:, 2] * np.sin(2 * q) + h[:, 3] * np.cos(2 * q)
        if self.compliance > 0.0:
            _, jacobian = self.kinematics.forward_with_jacobian(q)
            off = off - (self.compliance * self.mass * GRAVITY) * jacobian[2]
        return np.asarray(q + off)
