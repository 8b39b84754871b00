"""What an arm may be asked to do, and the checks before anything is sent. Defaults are those of a UR10e."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.errors import LimitError, check_positive, check_range, shown
from drivers.interfaces import Vector

_TURN = 2 * math.pi


@dataclass(frozen=True)
class ArmLimits:
    """Limits in SI units: `joints` (low, high) and `joint_speeds` per joint, in rad and rad/s.

    `joint_acceleration` rad/s², `linear_speed` m/s and `linear_acceleration` m/s² of the flange, `reach` m of the
    flange from the base's origin, `payload` kg.
    """

    joints: tuple[tuple[float, float], ...] = ((-_TURN, _TURN),) * 6
    joint_speeds: tuple[float, ...] = tuple(math.radians(v) for v in (120, 120, 180, 180, 180, 180))
    joint_acceleration: float = 8.0
    linear_speed: float = 1.0
    linear_acceleration: float = 5.0
    reach: float = 1.45
    payload: float = 12.5

    def check_joints(self, device: str, joints: Vector) -> Vector:
        """The joint angles (6,) in rad if all are inside the limits, else `LimitError`."""
        joints = _six(device, "joint angles", joints)
        for index, (angle, (low, high)) in enumerate(zip(joints, self.joints, strict=True)):
            check_range(device, f"angle of joint {index + 1}", angle, low=low, high=high, unit="rad")
        return joints

    def check_pose(self, device: str, flange: Vector) -> Vector:
        """The flange pose (6,) if its place is within reach, else `LimitError`."""
        flange = _six(device, "flange pose", flange)
        check_range(
            device, "distance of the flange from the base", float(np.linalg.norm(flange[:3])), 0, self.reach, unit="m"
        )
        return flange

    def check_joint_move(self, device: str, speed: float, acceleration: float) -> None:
        """`LimitError` unless speed (rad/s of the leading joint) and acceleration (rad/s²) are allowed."""
        check_positive(device, "joint speed", speed, max(self.joint_speeds), "rad/s")
        check_positive(device, "joint acceleration", acceleration, self.joint_acceleration, "rad/s^2")

    def check_linear_move(self, device: str, speed: float, acceleration: float) -> None:
        """`LimitError` unless speed (m/s) and acceleration (m/s²) of the flange are allowed."""
        check_positive(device, "flange speed", speed, self.linear_speed, "m/s")
        check_positive(device, "flange acceleration", acceleration, self.linear_acceleration, "m/s^2")

    def check_payload(self, device: str, mass: float, centre: Vector) -> tuple[float, tuple[float, float, float]]:
        """Mass in kg and centre of gravity (3,) in m if the arm may carry it, else `LimitError`."""
        if np.shape(centre) != (3,):
            raise LimitError(device, f"a centre of gravity is 3 numbers in m, not {centre}; nothing was sent")
        mass = check_range(device, "payload", mass, low=0.0, high=self.payload, unit="kg")
        x, y, z = (check_range(device, "payload offset", float(v), low=-0.5, high=0.5, unit="m") for v in centre)
        return mass, (x, y, z)

    def check_trajectory(self, device: str, times: Vector, joints: Vector) -> tuple[Vector, Vector]:
        """Times (n,) s and joints (n, 6) rad if they are in order, inside the limits and nowhere too fast. Raises
        `LimitError` that names the point."""
        times, joints = np.asarray(times, dtype=float), np.asarray(joints, dtype=float)
        if times.ndim != 1 or len(times) < 2 or joints.shape != (len(times), 6):
            raise LimitError(
                device,
                f"a trajectory needs at least 2 times (n,) and joints (n, 6); got {times.shape} and {joints.shape}",
            )
        if not (np.isfinite(times).all() and np.isfinite(joints).all()):
            raise LimitError(device, "the trajectory holds values that are not finite; nothing was sent")
        if times[0] != 0.0 or (np.diff(times) <= 0).any():
            raise LimitError(device, "the trajectory's times must begin at 0 s and increase; nothing was sent")
        for index, (low, high) in enumerate(self.joints):
            what = f"angle of joint {index + 1} on the trajectory"
            check_range(device, what, float(joints[:, index].min()), low=low, high=high, unit="rad")
            check_range(device, what, float(joints[:, index].max()), low=low, high=high, unit="rad")
        speeds = np.abs(np.diff(joints, axis=0)) / np.diff(times)[:, None]
        point, joint = np.unravel_index(int(np.argmax(speeds / np.array(self.joint_speeds))), speeds.shape)
        if speeds[point, joint] > self.joint_speeds[joint] * (1 + 1e-9):
            raise LimitError(
                device,
                f"joint {joint + 1} would turn at {shown(float(speeds[point, joint]), 'rad/s')} at "
                f"{times[point]:.3f} s, allowed up to {shown(self.joint_speeds[joint], 'rad/s')}; nothing was sent. "
                "Plan the trajectory slower.",
            )
        return times, joints


def _six(device: str, what: str, values: Vector) -> Vector:
    array = np.asarray(values, dtype=float)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise LimitError(device, f"{what} must be 6 finite numbers, got {array.tolist()}; nothing was sent")
    return array
