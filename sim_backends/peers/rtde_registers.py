"""The controller's general purpose registers and every variable that RTDE can read or write, by name.

Names and types follow the maker's RTDE guide; a `View` computes what is costly once per tick.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from sim_backends.models.arm import ArmModel, Power, Safety
from sim_backends.models.arm_kinematics import Matrix, Vector, pose_from_matrix

REGISTERS = 48

FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
"""`struct` code of every RTDE type; numbers are big-endian on the wire."""


class Registers:
    """General purpose registers; a program reads the inputs and writes the outputs."""

    def __init__(self) -> None:
        self.int_in = [0] * REGISTERS
        self.double_in = [0.0] * REGISTERS
        self.int_out = [0] * REGISTERS
        self.double_out = [0.0] * REGISTERS
        self.bits_out = [0, 0]
        self.commands = 0
        """How many packets have carried the command so far."""
        self.command_fields: frozenset[str] = frozenset()
        self.analog_out = [0.0, 0.0]


class View:
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
        return _SAFETY_BITS[self.model.safety]

    def robot_bits(self) -> int:
        """RTDE `robot_status_bits`: power on, program running."""
        return int(self.model.power is not Power.OFF) | int(self.runtime_state == 2) << 1


Getter = Callable[[View], Iterable[float]]

_ZERO3 = [0.0] * 3
_ZERO6 = [0.0] * 6
_SAFETY_BITS = {
    Safety.NORMAL: 1 << 0,
    Safety.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    Safety.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    Safety.EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}


def _momentum(view: View) -> float:
    return 5.0 * math.hypot(*view.tcp_speed()[:3])


OUTPUTS: dict[str, tuple[str, Getter]] = {
    "timestamp": ("DOUBLE", lambda v: (v.model.time,)),
    "target_q": ("VECTOR6D", lambda v: v.model.drive.q.tolist()),
    "target_qd": ("VECTOR6D", lambda v: v.model.drive.qd.tolist()),
    "target_qdd": ("VECTOR6D", lambda v: _ZERO6),
    "target_current": ("VECTOR6D", lambda v: _ZERO6),
    "target_moment": ("VECTOR6D", lambda v: _ZERO6),
    "actual_q": ("VECTOR6D", lambda v: v.model.drive.q.tolist()),
    "actual_qd": ("VECTOR6D", lambda v: v.model.drive.qd.tolist()),
    "actual_current": ("VECTOR6D", lambda v: _ZERO6),
    "actual_current_window": ("VECTOR6D", lambda v: _ZERO6),
    "joint_control_output": ("VECTOR6D", lambda v: _ZERO6),
    "actual_TCP_pose": ("VECTOR6D", View.tcp_pose),
    "actual_TCP_speed": ("VECTOR6D", View.tcp_speed),
    "actual_TCP_force": ("VECTOR6D", lambda v: v.model.felt.tolist()),
    "target_TCP_pose": ("VECTOR6D", View.tcp_pose),
    "target_TCP_speed": ("VECTOR6D", View.tcp_speed),
    "actual_digital_input_bits": ("UINT64", lambda v: (v.model.digital_inputs,)),
    "joint_temperatures": ("VECTOR6D", lambda v: [30.0] * 6),
    "actual_execution_time": ("DOUBLE", lambda v: (0.0,)),
    "robot_mode": ("INT32", lambda v: (int(v.model.power),)),
    "joint_mode": ("VECTOR6INT32", lambda v: [253 if v.model.power is Power.RUNNING else 239] * 6),
    "safety_mode": ("INT32", lambda v: (v.model.safety.value,)),
    "safety_status": ("INT32", lambda v: (v.model.safety.value,)),
    "actual_tool_accelerometer": ("VECTOR3D", lambda v: _ZERO3),
    "speed_scaling": ("DOUBLE", lambda v: (v.model.drive.speed_fraction,)),
    "target_speed_fraction": ("DOUBLE", lambda v: (v.model.drive.speed_fraction,)),
    "actual_momentum": ("DOUBLE", lambda v: (_momentum(v),)),
    "actual_main_voltage": ("DOUBLE", lambda v: (48.0,)),
    "actual_robot_voltage": ("DOUBLE", lambda v: (48.0 if v.model.power is not Power.OFF else 0.0,)),
    "actual_robot_current": ("DOUBLE", lambda v: (0.5,)),
    "actual_joint_voltage": ("VECTOR6D", lambda v: [48.0] * 6),
    "actual_digital_output_bits": ("UINT64", lambda v: (v.model.digital_outputs,)),
    "runtime_state": ("UINT32", lambda v: (v.runtime_state,)),
    "elbow_position": ("VECTOR3D", lambda v: _ZERO3),
    "elbow_velocity": ("VECTOR3D", lambda v: _ZERO3),
    "robot_status_bits": ("UINT32", lambda v: (v.robot_bits(),)),
    "safety_status_bits": ("UINT32", lambda v: (v.safety_bits(),)),
    "analog_io_types": ("UINT32", lambda v: (0,)),
    "standard_analog_input0": ("DOUBLE", lambda v: (0.0,)),
    "standard_analog_input1": ("DOUBLE", lambda v: (0.0,)),
    "standard_analog_output0": ("DOUBLE", lambda v: (v.registers.analog_out[0],)),
    "standard_analog_output1": ("DOUBLE", lambda v: (v.registers.analog_out[1],)),
    "io_current": ("DOUBLE", lambda v: (0.0,)),
    "tcp_force_scalar": ("DOUBLE", lambda v: (math.hypot(*v.model.felt[:3]),)),
    "ft_raw_wrench": ("VECTOR6D", View.raw_wrench),
    "payload": ("DOUBLE", lambda v: (v.model.payload[0],)),
    "payload_cog": ("VECTOR3D", lambda v: v.model.payload[1].tolist()),
    "payload_inertia": ("VECTOR6D", lambda v: _ZERO6),
    "output_bit_registers0_to_31": ("UINT32", lambda v: (v.registers.bits_out[0],)),
    "output_bit_registers32_to_63": ("UINT32", lambda v: (v.registers.bits_out[1],)),
}
"""Readable variables: type and how to read it. The registers are added below."""


def _add_registers() -> None:
    def reader(bank: str, index: int) -> Getter:
        return lambda view: (getattr(view.registers, bank)[index],)

    for i in range(REGISTERS):
        OUTPUTS[f"output_int_register_{i}"] = ("INT32", reader("int_out", i))
        OUTPUTS[f"output_double_register_{i}"] = ("DOUBLE", reader("double_out", i))
        OUTPUTS[f"input_int_register_{i}"] = ("INT32", reader("int_in", i))
        OUTPUTS[f"input_double_register_{i}"] = ("DOUBLE", reader("double_in", i))


_add_registers()

INPUTS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_registers32_to_63": "UINT32",
    "external_force_torque": "VECTOR6D",
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}
"""Writable variables and their types."""
