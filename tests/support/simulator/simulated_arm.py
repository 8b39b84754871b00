"""A simulated arm without its network, and the same arm built by Pinocchio."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams

TICK = 0.002
Array = NDArray[np.float64]


def pinocchio_arm(table: Array) -> pin.Model:
    """The same arm built from the DH table by another library."""
    model = pin.Model()
    parent, placement = 0, pin.SE3.Identity()
    for i, (a, d, alpha, offset) in enumerate(table):
        turn = pin.SE3(pin.utils.rotate("z", offset), np.zeros(3))
        parent = model.addJoint(parent, pin.JointModelRZ(), placement * turn, f"j{i}")
        placement = pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, d]))
    model.addFrame(pin.Frame("flange", parent, 0, placement, pin.FrameType.OP_FRAME))
    return model


def pinocchio_flange(table: Array, q: Array) -> Array:
    model = pinocchio_arm(table)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return np.asarray(data.oMf[model.getFrameId("flange")].homogeneous)


def make_arm(**params: object) -> ArmModel:
    return ArmModel(ArmParams(**params), np.random.default_rng(3), WorldClock())  # type: ignore[arg-type]


def run(arm: ArmModel, seconds: float, tick: float = TICK) -> None:
    for _ in range(round(seconds / tick)):
        arm.tick(arm.time + tick)


def finish(arm: ArmModel, limit: float = 30.0) -> float:
    """Tick until the motion has ended; the seconds it took."""
    start = arm.time
    while not arm.idle:
        assert arm.time - start < limit, "the motion does not end"
        arm.tick(arm.time + TICK)
    return arm.time - start
