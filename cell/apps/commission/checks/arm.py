"""The arm: each joint by itself, and what it carries by the force that it feels."""

import math

import numpy as np
import pinocchio as pin

from cell.apps.commission.check import CommissionCheck, Result, refused
from cell.apps.commission.workplace import CommissionWorkplace
from cell.measure.geometry.poses import from_ur
from cell.motion.kinematics import HOME
from drivers.errors import LimitError
from drivers.interfaces import Vector

STEP = math.radians(2.0)
SPEED, ACCELERATION = math.radians(4.0), math.radians(20.0)
MOST_OFF_DEG = 0.02
GRAVITY = 9.81
TURNS_DEG = ((0, 0), (-30, 0), (30, 0), (0, -35), (0, 35))
"""Of the two wrist joints 4 and 5, beside the folded posture."""
SAMPLES, PERIOD_S = 50, 0.02
MASS_OFF, CENTRE_OFF = 0.25, 0.025
"""kg and m by which a payload may differ from what the force tells."""


def _axes(workplace: CommissionWorkplace, result: Result) -> None:
    arm = workplace.devices.arm
    workplace.brake()
    kinematics = workplace.cell.mover(None).kinematics
    for joint in range(6):
        workplace.look_around()
        workplace.confirm(
            f"joint {joint + 1}", "this joint alone", "2 deg and back", f"{math.degrees(SPEED):.0f} deg/s"
        )
        start = arm.state()
        goal = start.joints.copy()
        goal[joint] += STEP
        arm.move_joints(goal, SPEED, ACCELERATION).wait(20.0)
        workplace.devices.clock.sleep(workplace.config.arm.settle_time)
        then = arm.state()
        turned = np.degrees(then.joints - start.joints)
        low, high = math.degrees(STEP) - MOST_OFF_DEG, math.degrees(STEP) + MOST_OFF_DEG
        result.measure(f"joint {joint + 1} turned", turned[joint], "deg", least=low, most=high)
        others = np.delete(np.abs(turned), joint).max()
        result.measure(f"any other joint turned, with joint {joint + 1}", others, "deg", most=MOST_OFF_DEG)
        way = from_ur(start.flange).inverse() * from_ur(then.flange)
        meant = kinematics.fk(start.joints).inverse() * kinematics.fk(then.joints)
        off = 1e3 * float(np.linalg.norm(way.translation - meant.translation))
        result.measure(f"flange off the model's way, joint {joint + 1}", off, "mm", most=0.1)
        arm.move_joints(start.joints, SPEED, ACCELERATION).wait(20.0)
    if not workplace.person.sees("Did each joint turn alone, a little way there and back, without touching anything?"):
        result.notes.append("a person saw a joint move otherwise: see that the arm is the one at arm.address")
        result.require("a person saw every joint move as announced", False)
    beyond = arm.state().joints.copy()
    beyond[5] = math.radians(400.0)
    stayed = refused(lambda: arm.move_joints(beyond, SPEED, ACCELERATION).wait(1.0), LimitError)
    result.require("a joint beyond its limit refused", stayed)


def _payload(workplace: CommissionWorkplace, result: Result) -> None:
    arm, config = workplace.devices.arm, workplace.config.arm
    workplace.fold()
    mover = workplace.mover()
    turns: list[Vector] = []
    wrenches: list[Vector] = []
    for fourth, fifth in TURNS_DEG:
        workplace.look_around()
        joints = HOME.copy()
        joints[3] += math.radians(fourth)
        joints[4] += math.radians(fifth)
        mover.to_joints(joints)
        samples = []
        for _ in range(SAMPLES):
            samples.append(arm.state().wrench)
            workplace.devices.clock.sleep(PERIOD_S)
        turns.append(from_ur(arm.state().flange).rotation)
        wrenches.append(np.mean(samples, axis=0))
    mover.to_joints(HOME)
    mass, moment, sigma = weigh(np.array(turns), np.array(wrenches))
    told = config.payload
    carried = told + mass
    centre = (told * np.array(config.payload_centre) + moment) / max(carried, 1e-3)
    off = float(np.linalg.norm(centre - np.array(config.payload_centre)))
    result.measure("weight that the arm was not told of", mass, "kg")
    remedy = "See that nothing touches the tool and no cable pulls."
    result.measure("its standard deviation", sigma, "kg", most=0.1, remedy=remedy)
    result.measure("centre of gravity away from what was told", 1e3 * off, "mm")
    if abs(mass) > MASS_OFF + 3.0 * sigma or (off > CENTRE_OFF and carried > 0.5):
        shown = ", ".join(f"{1e3 * v:.0f}" for v in centre)
        result.find(
            "arm.payload", "the arm carries another weight than it was told, by its force sensor at rest",
            f"{told:g} kg", f"{carried:.2f} kg with its centre at ({shown}) mm",
            "Weigh tool and part, and write both; with a wrong one the arm stops for no reason, or feels contact "
            "late.",
            write={
                "arm.payload": f'"{carried:.1f} kg"',
                "arm.payload_centre": "[" + ", ".join(f'"{round(1e3 * float(v)):d} mm"' for v in centre) + "]",
            },
        )  # fmt: skip


def weigh(turns: Vector, wrenches: Vector) -> tuple[float, Vector, float]:
    """Mass (kg) and moment (3,) (kg m, in the flange frame) that act beyond what the arm takes away by itself.

    `turns` (n, 3, 3) are base_from_flange, `wrenches` (n, 6) at the flange in base axes. The sensor's own zero, fixed
    to the flange, is solved for as well, so at least three different turns are needed. Also the mass's deviation, kg.
    """
    down = np.array([0.0, 0.0, -GRAVITY])
    rows, told = [], []
    for turn, wrench in zip(turns, wrenches, strict=True):
        force = np.zeros((3, 10))
        force[:, 0] = down
        force[:, 4:7] = turn
        torque = np.zeros((3, 10))
        # (R c m) x g, linear in the moment c m.
        torque[:, 1:4] = -pin.skew(down) @ turn
        torque[:, 7:10] = turn
        rows += [force, torque]
        told += [wrench[:3], wrench[3:]]
    matrix, measured = np.concatenate(rows), np.concatenate(told)
    found, *_ = np.linalg.lstsq(matrix, measured, rcond=None)
    forces = (np.arange(len(measured)) // 3) % 2 == 0
    residual = (matrix @ found - measured)[forces]
    freedom = max(1, len(residual) - 4)
    spread = np.linalg.inv(matrix[forces][:, [0, 4, 5, 6]].T @ matrix[forces][:, [0, 4, 5, 6]])[0, 0]
    sigma = float(np.sqrt(spread * (residual**2).sum() / freedom))
    return float(found[0]), np.asarray(found[1:4]), sigma


CHECKS = [
    CommissionCheck(
        "arm_axes", "Arm: each joint alone, direction and unit",
        "one joint after the other", far="2 deg and back", fast=f"{math.degrees(SPEED):.0f} deg/s",
        limit=f"2 deg within {MOST_OFF_DEG} deg, no other joint, flange as the model has it; beyond a limit refused",
        keys=("arm.model", "arm.address"), needs=("links",), work=_axes,
    ),
    CommissionCheck(
        "payload", "Arm: what it carries, by the force that it feels at rest",
        "the arm to its folded posture, then two wrist joints", far="up to 35 deg", fast="15 deg/s, 150 mm/s",
        limit=f"within {MASS_OFF} kg and {1e3 * CENTRE_OFF:.0f} mm of arm.payload and arm.payload_centre",
        keys=("arm.payload", "arm.payload_centre"), needs=("arm_axes",), work=_payload,
    ),
]  # fmt: skip
