"""The controller's general purpose registers, and the arm's state as RTDE shows it."""

from __future__ import annotations

import numpy as np

from sim_backends.models.arm import ArmModel, Power, Safety
from sim_backends.models.arm_kinematics import Matrix, Vector, pose_from_matrix

REGISTERS = 48
BITS = 128


class Registers:
    """General purpose registers; a program reads the inputs and writes the outputs."""

    def __init__(self) -> None:
        self.int_in = [0] * REGISTERS
        self.double_in = [0.0] * REGISTERS
        self.int_out = [0] * REGISTERS
        self.double_out = [0.0] * REGISTERS
        self.bits_in = [False] * BITS
        self.bits_out = [False] * BITS
        self.commands = 0
        """How many packets have carried the command so far."""
        self.command_fields: frozenset[str] = frozenset()
        self.external_force = [0.0] * 6
        self.analog_out = [0.0, 0.0]
        self.written: dict[str, int] = {}
        """How often clients have written to the inputs that a program watches."""


_SAFETY_BITS = {
    1: 1 << 0,
    2: 1 << 1,
    Safety.PROTECTIVE_STOP.value: 1 << 2 | 1 << 10,
    Safety.SAFEGUARD_STOP.value: 1 << 4 | 1 << 10,
    Safety.EMERGENCY_STOP.value: 1 << 6 | 1 << 7 | 1 << 10,
}
"""By the number of the safety system's state."""


class RegisterView:
    """The arm's and the program's state as RTDE shows it, computed at most once per tick."""

    def __init__(self, model: ArmModel, registers: Registers) -> None:
        self.model = model
        self.registers = registers
        self.runtime_state = 1
        self._q: Vector | None = None
        self._qd: Vector | None = None
        self._tool: Matrix | None = None
        self._turn = np.eye(3)
        self._jacobian: Matrix = np.eye(6)
        self._pose: list[float] = []
        self._speed: list[float] = []

    def tcp_pose(self) -> list[float]:
        """Tool pose as a 6-vector."""
        self._update()
        return self._pose

    def tcp_speed(self) -> list[float]:
        """Tool velocity and rotation rate (6,) in base axes."""
        self._update()
        if self._qd is not self.model.drive.qd:
            self._qd = self.model.drive.qd
            self._speed = self._jacobian.dot(self._qd).tolist()
        return self._speed

    def raw_wrench(self) -> list[float]:
        """What the force sensor in the flange feels, in flange axes, without any zero."""
        self._update()
        wrench = self.model.wrench
        return [*wrench[:3].dot(self._turn).tolist(), *wrench[3:].dot(self._turn).tolist()]

    def _update(self) -> None:
        drive = self.model.drive
        if self._q is drive.q and self._tool is drive.flange_from_tcp:
            return
        self._q, self._tool, self._qd = drive.q, drive.flange_from_tcp, None
        flange, self._jacobian = drive.tcp_state()
        self._turn = flange[:3, :3]
        self._pose = pose_from_matrix(flange.dot(self._tool)).tolist()

    def safety_bits(self) -> int:
        """RTDE `safety_status_bits`."""
        return _SAFETY_BITS[self.model.safety_mode]

    def tcp_offset(self) -> list[float]:
        """The tool in the flange as a 6-vector."""
        return list(pose_from_matrix(self.model.drive.flange_from_tcp).tolist())

    def robot_bits(self) -> int:
        """RTDE `robot_status_bits`: power on, program running."""
        return int(self.model.power is not Power.OFF) | int(self.runtime_state == 2) << 1
