"""The arms that the cell knows by name: the maker's table, and how thick their links are.

A controller's own table, calibrated in the factory, belongs to one of them: it is told apart here from that of another
model. Sources: docs/reference/protocols.md, section 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from cell.motion.kinematics import ArmKinematics, DenavitHartenberg, JointLimits, Joints
from drivers.errors import ConfigError
from drivers.link_table import LinkTable

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
    """One model: lengths of the maker's table in m, and the thickness of its links in m.

    `upper` and `forearm` are how far the two long links lie beside joint 2, along its axis, and their radius; `wrist`
    and `base` are radii.
    """

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
    """The kinematics of an arm of `model` whose controller told its own table, or none: then it is the maker's.

    Raises `ConfigError` when what it told belongs to no arm of this model; the text names the model that is nearest.
    """
    nominal = MODELS[model].table
    if told is None:
        return ArmKinematics(nominal, limits)
    factory = DenavitHartenberg(told.d, told.a, told.alpha, told.theta)
    made = ArmKinematics(factory, limits, nominal)
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
