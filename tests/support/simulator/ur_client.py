"""The real ur_rtde at a simulated arm in a process of its own, and its kinematics from the maker's table.

ur_rtde's constructors hold the interpreter's lock, and it does not survive the loss of its link: the arm outlives it.
"""

import math
from collections.abc import Callable

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from rtde_control import RTDEControlInterface
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface

from drivers.clock import Clock
from tests.support.wire.arm_bench import HOME, ArmBench, dashboard, soon

SPEED = 5.0
CLOCK = Clock()
DH = [
    (0.0, 0.1807, math.pi / 2), (-0.6127, 0.0, 0.0), (-0.57155, 0.0, 0.0), (0.0, 0.17415, math.pi / 2),
    (0.0, 0.11985, -math.pi / 2), (0.0, 0.11655, 0.0),
]  # fmt: skip
"""a, d, alpha of the UR10e as the maker publishes them."""


def flange(q: NDArray[np.float64] | list[float]) -> pin.SE3:
    pose = pin.SE3.Identity()
    for (a, d, alpha), angle in zip(DH, q, strict=True):
        pose = pose * pin.SE3(pin.utils.rotate("z", angle), np.zeros(3))
        pose = pose * pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, d]))
    return pose


def se3(pose: list[float]) -> pin.SE3:
    return pin.SE3(pin.exp3(np.array(pose[3:])), np.array(pose[:3]))


def distance(a: pin.SE3, b: pin.SE3) -> float:
    return float(np.linalg.norm(pin.log6(a.actInv(b)).vector))


def until(condition: Callable[[], bool], timeout: float = 5.0) -> None:
    assert soon(condition, timeout), "it did not happen in time"


class Client:
    """ur_rtde's three interfaces to one arm."""

    def __init__(self, simulator: ArmBench) -> None:
        self.simulator = simulator
        self.receive = RTDEReceiveInterface(simulator.address)
        self.control = RTDEControlInterface(simulator.address)
        self.io = RTDEIOInterface(simulator.address)

    def q(self) -> NDArray[np.float64]:
        return np.array(self.receive.getActualQ())

    def recover(self) -> None:
        """Everything as after the start: safety normal, program running, arm at home."""
        self.simulator.ask("clear")
        for command in ("power on", "brake release"):
            dashboard(self.simulator.address, command)
        until(lambda: self.receive.getRobotMode() == 7)
        self.control.reuploadScript()
        until(lambda: bool(self.control.isProgramRunning()))
        assert self.control.moveJ(HOME.tolist(), 2.0, 20.0) and self.control.setTcp([0.0] * 6)
