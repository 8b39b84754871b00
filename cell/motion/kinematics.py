"""Forward and inverse kinematics of the six-axis arm, and the models that the cell knows by name.

The model is built in code from a Denavit–Hartenberg table, the maker's or the one that the factory calibrated. The
closed form of the maker's arm, with three parallel axes, lists the branches; Gauss–Newton on Pinocchio's model makes
each of them exact. Sources: docs/reference/protocols.md, section 1.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from drivers.errors import ConfigError, RefusedError
from drivers.interfaces import LinkTable

Joints = NDArray[np.float64]
"""Joint angles of shape (6,), rad."""

TURN = 2.0 * np.pi
SAME_RAD = 1e-4
"""Two branches whose joints differ by less are one."""


class Unreachable(RefusedError):
    """No joint angles within the limits bring the flange to the pose; the text says how far it stays away."""


@dataclass(frozen=True)
class DenavitHartenberg:
    """Table of an arm, by joint: d and a in m, alpha and theta in rad; theta is added to the joint's angle. Default:
    UR10e (docs/reference/protocols.md, section 1)."""

    d: tuple[float, ...] = (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
    a: tuple[float, ...] = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)
    alpha: tuple[float, ...] = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
    theta: tuple[float, ...] = (0.0,) * 6

    def link(self, joint: int) -> pin.SE3:
        """Transformation from the frame that turns with joint 0 … 5 to the next joint's frame (the flange for 5)."""
        rotation = pin.utils.rotate("x", self.alpha[joint])
        return pin.SE3(rotation, np.array([self.a[joint], 0.0, self.d[joint]]))

    def frames_at_zero(self) -> list[pin.SE3]:
        """With all joints at 0: the six frames about whose z the joints turn, and the flange, in the base."""
        frames = [pin.SE3.Identity()]
        for joint in range(6):
            frames.append(frames[-1] * _turn(self.theta[joint]) * self.link(joint))
        return frames


@dataclass(frozen=True)
class JointLimits:
    """Ranges in rad, speeds in rad/s, accelerations in rad/s², jerks in rad/s³, each for six joints."""

    lower: tuple[float, ...] = (-TURN, -TURN, -np.pi, -TURN, -TURN, -TURN)
    upper: tuple[float, ...] = (TURN, TURN, np.pi, TURN, TURN, TURN)
    speed: tuple[float, ...] = (1.6, 1.6, 2.0, 2.6, 2.6, 2.6)
    acceleration: tuple[float, ...] = (3.0, 3.0, 4.0, 6.0, 6.0, 6.0)
    jerk: tuple[float, ...] = (20.0, 20.0, 25.0, 40.0, 40.0, 40.0)

    def __post_init__(self) -> None:
        for name in ("speed", "acceleration", "jerk"):
            values = getattr(self, name)
            if len(values) != 6 or not all(0.0 < v < np.inf for v in values):
                raise ValueError(f"joint {name} limits {values} must be six finite values greater than 0")
        if len(self.lower) != 6 or len(self.upper) != 6 or not all(np.less(self.lower, self.upper)):
            raise ValueError(f"joint ranges {self.lower} … {self.upper} rad must be six pairs with lower < upper")

    def inside(self, joints: Joints) -> bool:
        """True when every angle lies in its range."""
        return bool(np.all(joints >= self.lower) and np.all(joints <= self.upper))


class ArmKinematics:
    """The arm from its base to its flange. An instance holds work space: use one per thread."""

    def __init__(
        self,
        table: DenavitHartenberg | None = None,
        limits: JointLimits | None = None,
        nominal: DenavitHartenberg | None = None,
    ) -> None:
        """`table` is exact; `nominal` is the maker's, which it is a calibration of (none: `table` itself)."""
        self.table = table or DenavitHartenberg()
        self.nominal = nominal or self.table
        self.limits = limits or JointLimits()
        self.model = pin.Model()
        *drawn, _ = self.nominal.frames_at_zero()
        *axes, flange = self.table.frames_at_zero()
        parent, base_from_parent = 0, pin.SE3.Identity()
        for joint in range(6):
            base_from_joint = _anchored(axes[joint], drawn[joint])
            placement = base_from_parent.actInv(base_from_joint)
            parent = self.model.addJoint(parent, pin.JointModelRZ(), placement, f"joint_{joint + 1}")
            base_from_parent = base_from_joint
        self.joint6_from_flange = base_from_parent.actInv(flange)
        self._flange = self.model.addFrame(pin.Frame("flange", parent, self.joint6_from_flange, pin.FrameType.OP_FRAME))
        self._data = self.model.createData()

    def fk(self, joints: Joints) -> pin.SE3:
        """base_from_flange at the joint angles (6,), rad."""
        pin.forwardKinematics(self.model, self._data, np.asarray(joints, dtype=np.float64))
        return pin.updateFramePlacement(self.model, self._data, self._flange).copy()

    def placements(self, joints: Joints) -> list[pin.SE3]:
        """At the joint angles (6,): each joint's frame in the one before it, the first in the base; then the flange in
        the last joint's."""
        pin.forwardKinematics(self.model, self._data, np.asarray(joints, dtype=np.float64))
        return [*(self._data.liMi[k].copy() for k in range(1, 7)), self.joint6_from_flange]

    def jacobian(self, joints: Joints) -> NDArray[np.float64]:
        """(6, 6) flange velocity (linear, then angular, in flange axes) per joint speed."""
        jacobian: NDArray[np.float64] = pin.computeFrameJacobian(
            self.model, self._data, np.asarray(joints, dtype=np.float64), self._flange, pin.ReferenceFrame.LOCAL
        )
        return jacobian

    def refine(self, base_from_flange: pin.SE3, seed: Joints, steps: int = 40) -> tuple[Joints, float]:
        """Damped Gauss–Newton from `seed`: the angles found and the remaining error (m, with 1 rad taken as 1 m)."""
        joints = np.array(seed, dtype=np.float64)
        error = _error(self.fk(joints), base_from_flange)
        damping = 1e-8
        for _ in range(steps):
            if np.linalg.norm(error) < 1e-11:
                break
            jacobian = self.jacobian(joints)
            step = np.linalg.solve(jacobian.T @ jacobian + damping * np.eye(6), jacobian.T @ error)
            trial = joints + step * min(1.0, 0.5 / max(1e-12, float(np.abs(step).max())))
            trial_error = _error(self.fk(trial), base_from_flange)
            if trial_error @ trial_error < error @ error:
                joints, error, damping = trial, trial_error, max(damping / 10, 1e-12)
            else:
                damping *= 20
            if damping > 1e3:
                break
        return joints, float(np.linalg.norm(error))

    def solutions(self, base_from_flange: pin.SE3, seed: Joints) -> list[Joints]:
        """All branches within the limits, each turned by whole turns next to `seed`, the nearest to `seed` first."""
        found: list[Joints] = []
        for start in [np.asarray(seed, dtype=np.float64), *self._branches(base_from_flange, seed)]:
            joints, error = self.refine(base_from_flange, start)
            joints = self.unwound(joints, seed)
            if (
                error < 1e-7
                and self.limits.inside(joints)
                and not any(np.abs(joints - f).max() < SAME_RAD for f in found)
            ):
                found.append(joints)
        return sorted(found, key=lambda q: float(np.sum((q - seed) ** 2)))

    def ik(self, base_from_flange: pin.SE3, seed: Joints) -> Joints:
        """The joint angles nearest to `seed` that reach the pose; `Unreachable` when there are none."""
        found = self.solutions(base_from_flange, seed)
        if found:
            return found[0]
        starts = [np.asarray(seed, dtype=np.float64), *self._branches(base_from_flange, seed)]
        best, _ = min((self.refine(base_from_flange, s) for s in starts), key=lambda pair: pair[1])
        gap = _error(self.fk(best), base_from_flange)
        x, y, z = base_from_flange.translation
        why = "the joint limits are in the way" if np.linalg.norm(gap) < 1e-6 else "it is out of reach"
        raise Unreachable(
            f"flange pose ({x:.3f}, {y:.3f}, {z:.3f}) m in the arm base cannot be reached: {why}; the nearest pose "
            f"found stays {1e3 * float(np.linalg.norm(gap[:3])):.1f} mm and "
            f"{np.degrees(np.linalg.norm(gap[3:])):.2f} deg away. "
            "Bring arm and station nearer to each other, or change the pose in the job"
        )

    def track(self, base_from_flange: pin.SE3, previous: Joints) -> Joints:
        """The angles on the same branch as `previous`, for a pose close by; `Unreachable` when it cannot follow."""
        joints, error = self.refine(base_from_flange, previous, steps=15)
        if error > 1e-7 or not self.limits.inside(joints):
            x, y, z = base_from_flange.translation
            raise Unreachable(
                f"the arm cannot follow the line past ({x:.3f}, {y:.3f}, {z:.3f}) m: "
                "its reach or a joint limit ends there"
            )
        return joints

    def manipulability(self, joints: Joints) -> float:
        """Smallest singular value of the Jacobian, with 1 m taken as 1 rad; 0 in a singularity."""
        return float(np.linalg.svd(self.jacobian(joints), compute_uv=False)[-1])

    def unwound(self, joints: Joints, seed: Joints) -> Joints:
        """The same posture with each joint as few turns from `seed` as its limits allow."""
        lower, upper = np.array(self.limits.lower), np.array(self.limits.upper)
        near = joints + TURN * np.round((np.asarray(seed) - joints) / TURN)
        near = np.where(near > upper, near - TURN, near)
        return np.where(near < lower, near + TURN, near)

    def _branches(self, base_from_flange: pin.SE3, seed: Joints) -> list[Joints]:
        """Up to eight closed-form solutions for three parallel axes; out of reach they end at the nearest stretch."""
        d, a, table = self.nominal.d, self.nominal.a, self.nominal
        rotation = base_from_flange.rotation
        wrist = base_from_flange.translation - d[5] * rotation[:, 2]
        reach = float(np.hypot(wrist[0], wrist[1]))
        swing = np.arccos(np.clip(d[3] / max(reach, 1e-9), -1.0, 1.0))
        found = []
        for shoulder, flip, elbow in product((1.0, -1.0), repeat=3):
            q1 = np.arctan2(wrist[1], wrist[0]) + shoulder * swing + np.pi / 2
            s1, c1 = np.sin(q1), np.cos(q1)
            x, y, _ = base_from_flange.translation
            q5 = flip * np.arccos(np.clip((x * s1 - y * c1 - d[3]) / d[5], -1.0, 1.0))
            s5 = np.sin(q5)
            q6 = float(seed[5])
            if abs(s5) > 1e-6:
                q6 = np.arctan2(
                    (-rotation[0, 1] * s1 + rotation[1, 1] * c1) / s5, (rotation[0, 0] * s1 - rotation[1, 0] * c1) / s5
                )
            last = _turn(q5) * table.link(4) * _turn(q6) * table.link(5)
            first = _turn(q1) * table.link(0)
            middle = first.inverse() * base_from_flange * last.inverse() * table.link(3).inverse()
            px, py = middle.translation[:2]
            span = max(float(np.hypot(px, py)), 1e-9)
            cosine = np.clip((span**2 - a[1] ** 2 - a[2] ** 2) / (2 * a[1] * a[2]), -1.0, 1.0)
            q3 = elbow * np.arccos(cosine)
            q2 = np.arctan2(py, px) - np.arctan2(a[2] * np.sin(q3), a[1] + a[2] * np.cos(q3))
            q4 = np.arctan2(middle.rotation[1, 0], middle.rotation[0, 0]) - q2 - q3
            found.append(np.array([q1, q2, q3, q4, q5, q6]))
        return found


def _turn(angle: float) -> pin.SE3:
    return pin.SE3(pin.utils.rotate("z", angle), np.zeros(3))


def _anchored(axis: pin.SE3, drawn: pin.SE3) -> pin.SE3:
    """The frame on the z axis of `axis` that is nearest to the frame `drawn`.

    A factory's table has its frames where common normals happen to lie, up to hundreds of metres along the axes. A
    link's body hangs on the frame where the drawing has it.
    """
    z = axis.rotation[:, 2]
    x = drawn.rotation[:, 0] - z * (z @ drawn.rotation[:, 0])
    x /= np.linalg.norm(x)
    along = z @ (drawn.translation - axis.translation)
    return pin.SE3(np.column_stack([x, np.cross(z, x), z]), axis.translation + along * z)


def _error(pose: pin.SE3, target: pin.SE3) -> NDArray[np.float64]:
    error: NDArray[np.float64] = pin.log6(pose.actInv(target)).vector
    return error


MOST_FACTORY_M, MOST_FACTORY_RAD = 0.02, 0.06
"""How far a factory's table may carry the flange off the maker's. Three published ones carry it by up to 8 mm, 23 mrad;
the nearest two models, UR3 and UR3e, are 29 mm apart."""
HOME: Joints = np.deg2rad([90.0, -100.0, 100.0, -90.0, -90.0, 0.0])
"""Where `cell home` brings the arm, and where jobs and calibrations begin: folded above the deck, tool down.

Postures are chosen nearest to the present one, so a fixed beginning keeps the arm in one of its configurations.
"""
_POSTURES: Joints = np.random.default_rng(1).uniform(-2.8, 2.8, (24, 6))


@dataclass(frozen=True)
class ArmDimensions:
    """One model: lengths of the maker's table in m, and the thickness of its links in m. `upper` and `forearm` are how
    far the two long links lie beside joint 2, along its axis, and their radius; `wrist` and `base` are radii."""

    name: str
    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float
    upper: tuple[float, float]
    forearm: tuple[float, float]
    wrist: float
    base: float

    @property
    def table(self) -> DenavitHartenberg:
        """The maker's table."""
        return DenavitHartenberg(
            d=(self.d1, 0.0, 0.0, self.d4, self.d5, self.d6), a=(0.0, self.a2, self.a3, 0.0, 0.0, 0.0)
        )

    @property
    def reach(self) -> float:
        """The flange is never farther than this from joint 1's axis, m, with 30 mm to spare."""
        return 0.03 - self.a2 - self.a3 + self.d5 + self.d6


_SMALL = (0.12, 0.060), (0.030, 0.045), 0.045, 0.07
_MIDDLE = (0.137, 0.072), (0.007, 0.058), 0.048, 0.075
_LARGE = (0.176, 0.075), (0.042, 0.060), 0.050, 0.095
_HEAVY = (0.25, 0.095), (0.043, 0.080), 0.056, 0.12

MODELS = {
    model.name: model
    for model in (
        ArmDimensions("UR3", 0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819, *_SMALL),
        ArmDimensions("UR5", 0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823, *_MIDDLE),
        ArmDimensions("UR10", 0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922, *_LARGE),
        ArmDimensions("UR3e", 0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921, *_SMALL),
        ArmDimensions("UR5e", 0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996, *_MIDDLE),
        ArmDimensions("UR7e", 0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996, *_MIDDLE),
        ArmDimensions("UR10e", 0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655, *_LARGE),
        ArmDimensions("UR12e", 0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655, *_LARGE),
        ArmDimensions("UR16e", 0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655, *_LARGE),
        ArmDimensions("UR20", 0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543, *_HEAVY),
        ArmDimensions("UR30", 0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543, *_HEAVY),
    )
}
"""By the maker's name. The UR7e has the links of the UR5e, the UR12e those of the UR10e."""


def arm_kinematics(model: str, told: LinkTable | None, limits: JointLimits | None = None) -> ArmKinematics:
    """The kinematics of an arm of `model` whose controller told its own table, or none: then it is the maker's. Raises
    `ConfigError` when what it told belongs to no arm of this model; the text names the model that is nearest."""
    nominal = MODELS[model].table
    if told is None:
        return ArmKinematics(nominal, limits)
    made = ArmKinematics(DenavitHartenberg(told.d, told.a, told.alpha, told.theta), limits, nominal)
    way, turn = _apart(made, ArmKinematics(nominal))
    if way > MOST_FACTORY_M or turn > MOST_FACTORY_RAD:
        away = {name: _apart(made, ArmKinematics(other.table))[0] for name, other in MODELS.items()}
        nearest = min(away, key=lambda name: away[name])
        raise ConfigError(
            f'arm.model = "{model}", but the controller computes with another arm\'s lengths: its flange is up to '
            f"{1e3 * way:.1f} mm and {1e3 * turn:.1f} mrad from where a {model} has it, allowed for a factory "
            f"calibration {1e3 * MOST_FACTORY_M:.0f} mm and {1e3 * MOST_FACTORY_RAD:.0f} mrad. The nearest model is "
            f"{nearest} ({1e3 * away[nearest]:.1f} mm): correct arm.model, or arm.address"
        )
    return made


def kinematics_name(model: str, told: LinkTable | None) -> str:
    """What the kinematics of an arm is called in a calibration: the hash of its table, or that it is the maker's."""
    return f"{model} as drawn" if told is None else f"{model} {told.hash()}"


def _apart(first: ArmKinematics, second: ArmKinematics) -> tuple[float, float]:
    """How far two arms bring their flanges apart at most over some postures, m and rad."""
    ways, turns = [], []
    for joints in _POSTURES:
        apart = first.fk(joints).actInv(second.fk(joints))
        ways.append(float(np.linalg.norm(apart.translation)))
        turns.append(float(np.linalg.norm(pin.log3(apart.rotation))))
    return max(ways), max(turns)
