"""Every variable that RTDE can read or write, by name: its type, and how it is read.

Names and types follow the maker's RTDE guide. What the simulated arm has nothing of, currents, temperatures, the tool's
connector, is zero or a usual value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from sim_backends.models.arm import Power
from sim_backends.peers.arm.rtde.registers import BITS, REGISTERS, RegisterView

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

Getter = Callable[[RegisterView], Iterable[float]]


def _momentum(view: RegisterView) -> float:
    return 5.0 * math.hypot(*view.tcp_speed()[:3])


def _always(*values: float) -> Getter:
    return lambda view: values


_SIX = _always(*[0.0] * 6)
_THREE = _always(*[0.0] * 3)
_ZERO = _always(0)

OUTPUTS: dict[str, tuple[str, Getter]] = {
    "timestamp": ("DOUBLE", lambda v: (v.model.time,)),
    "target_q": ("VECTOR6D", lambda v: v.model.drive.q.tolist()),
    "target_qd": ("VECTOR6D", lambda v: v.model.drive.qd.tolist()),
    "target_qdd": ("VECTOR6D", _SIX),
    "target_current": ("VECTOR6D", _SIX),
    "target_moment": ("VECTOR6D", _SIX),
    "actual_q": ("VECTOR6D", lambda v: v.model.drive.q.tolist()),
    "actual_qd": ("VECTOR6D", lambda v: v.model.drive.qd.tolist()),
    "actual_current": ("VECTOR6D", _SIX),
    "actual_current_window": ("VECTOR6D", _SIX),
    "actual_current_as_torque": ("VECTOR6D", _SIX),
    "joint_control_output": ("VECTOR6D", _SIX),
    "actual_TCP_pose": ("VECTOR6D", RegisterView.tcp_pose),
    "actual_TCP_speed": ("VECTOR6D", RegisterView.tcp_speed),
    "actual_TCP_acceleration": ("VECTOR6D", _SIX),
    "actual_TCP_force": ("VECTOR6D", lambda v: v.model.felt.tolist()),
    "target_TCP_pose": ("VECTOR6D", RegisterView.tcp_pose),
    "target_TCP_speed": ("VECTOR6D", RegisterView.tcp_speed),
    "target_TCP_acceleration": ("VECTOR6D", _SIX),
    "tcp_offset": ("VECTOR6D", RegisterView.tcp_offset),
    "actual_digital_input_bits": ("UINT64", lambda v: (v.model.digital_inputs,)),
    "actual_configurable_digital_input_bits": ("UINT64", lambda v: (v.model.digital_inputs >> 8 & 255,)),
    "joint_temperatures": ("VECTOR6D", _always(*[30.0] * 6)),
    "actual_execution_time": ("DOUBLE", _ZERO),
    "target_execution_time": ("DOUBLE", _ZERO),
    "robot_mode": ("INT32", lambda v: (int(v.model.power),)),
    "joint_mode": ("VECTOR6INT32", lambda v: [253 if v.model.power is Power.RUNNING else 239] * 6),
    "safety_mode": ("INT32", lambda v: (v.model.safety_mode,)),
    "safety_status": ("INT32", lambda v: (v.model.safety_mode,)),
    "actual_tool_accelerometer": ("VECTOR3D", _THREE),
    "speed_scaling": ("DOUBLE", lambda v: (v.model.drive.speed_fraction,)),
    "target_speed_fraction": ("DOUBLE", lambda v: (v.model.drive.speed_fraction,)),
    "actual_momentum": ("DOUBLE", lambda v: (_momentum(v),)),
    "actual_main_voltage": ("DOUBLE", _always(48.0)),
    "actual_robot_voltage": ("DOUBLE", lambda v: (48.0 if v.model.power is not Power.OFF else 0.0,)),
    "actual_robot_current": ("DOUBLE", _always(0.5)),
    "actual_joint_voltage": ("VECTOR6D", _always(*[48.0] * 6)),
    "actual_robot_energy_consumed": ("DOUBLE", _ZERO),
    "actual_robot_braking_energy_dissipated": ("DOUBLE", _ZERO),
    "actual_digital_output_bits": ("UINT64", lambda v: (v.model.digital_outputs,)),
    "actual_configurable_digital_output_bits": ("UINT64", lambda v: (v.model.digital_outputs >> 8 & 255,)),
    "runtime_state": ("UINT32", lambda v: (v.runtime_state,)),
    "elbow_position": ("VECTOR3D", _THREE),
    "elbow_velocity": ("VECTOR3D", _THREE),
    "robot_status_bits": ("UINT32", lambda v: (v.robot_bits(),)),
    "safety_status_bits": ("UINT32", lambda v: (v.safety_bits(),)),
    "analog_io_types": ("UINT32", _ZERO),
    "standard_analog_input0": ("DOUBLE", _ZERO),
    "standard_analog_input1": ("DOUBLE", _ZERO),
    "standard_analog_output0": ("DOUBLE", lambda v: (v.registers.analog_out[0],)),
    "standard_analog_output1": ("DOUBLE", lambda v: (v.registers.analog_out[1],)),
    "io_current": ("DOUBLE", _ZERO),
    "euromap67_input_bits": ("UINT32", _ZERO),
    "euromap67_output_bits": ("UINT32", _ZERO),
    "euromap67_24V_voltage": ("DOUBLE", _ZERO),
    "euromap67_24V_current": ("DOUBLE", _ZERO),
    "tool_mode": ("UINT32", lambda v: (253 if v.model.power is Power.RUNNING else 239,)),
    "tool_analog_input_types": ("UINT32", _ZERO),
    "tool_analog_input0": ("DOUBLE", _ZERO),
    "tool_analog_input1": ("DOUBLE", _ZERO),
    "tool_output_voltage": ("INT32", _ZERO),
    "tool_output_current": ("DOUBLE", _ZERO),
    "tool_temperature": ("DOUBLE", _always(30.0)),
    "tool_output_mode": ("UINT8", _ZERO),
    "tool_digital_output0_mode": ("UINT8", _ZERO),
    "tool_digital_output1_mode": ("UINT8", _ZERO),
    "tcp_force_scalar": ("DOUBLE", lambda v: (math.hypot(*v.model.felt[:3]),)),
    "joint_position_deviation_ratio": ("DOUBLE", _ZERO),
    "collision_detection_ratio": ("DOUBLE", _ZERO),
    "time_scale_source": ("INT32", _ZERO),
    "ft_raw_wrench": ("VECTOR6D", RegisterView.raw_wrench),
    "wrench_calc_from_currents": ("VECTOR6D", _SIX),
    "payload": ("DOUBLE", lambda v: (v.model.payload[0],)),
    "payload_cog": ("VECTOR3D", lambda v: v.model.payload[1].tolist()),
    "payload_inertia": ("VECTOR6D", _SIX),
    "script_control_line": ("UINT32", _ZERO),
    "target_gravity": ("VECTOR3D", _always(0.0, 0.0, 9.82)),
    "target_base_acceleration": ("VECTOR6D", _SIX),
    "target_base_wrench": ("VECTOR6D", _SIX),
    "control_step": ("UINT64", lambda v: (round(v.model.time * 500.0),)),
    "encoder0_raw": ("INT32", _ZERO),
    "encoder1_raw": ("INT32", _ZERO),
}
"""Readable variables: type and how to read it. The registers are added below."""

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
    "external_force_torque": "VECTOR6D",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_registers32_to_63": "UINT32",
    **{f"input_bit_register_{i}": "BOOL" for i in range(64, BITS)},
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}
"""Writable variables and their types."""


def word(bits: Sequence[bool]) -> int:
    """Bits as a number, the first one least."""
    return sum(bool(bit) << place for place, bit in enumerate(bits))


def _add_registers() -> None:
    def one(bank: str, index: int) -> Getter:
        return lambda view: (getattr(view.registers, bank)[index],)

    def many(bank: str, first: int) -> Getter:
        return lambda view: (word(getattr(view.registers, bank)[first : first + 32]),)

    for way, bits in (("input", "bits_in"), ("output", "bits_out")):
        short = "in" if way == "input" else "out"
        OUTPUTS[f"{way}_bit_registers0_to_31"] = ("UINT32", many(bits, 0))
        OUTPUTS[f"{way}_bit_registers32_to_63"] = ("UINT32", many(bits, 32))
        for i in range(64, BITS):
            OUTPUTS[f"{way}_bit_register_{i}"] = ("BOOL", one(bits, i))
        for i in range(REGISTERS):
            OUTPUTS[f"{way}_int_register_{i}"] = ("INT32", one(f"int_{short}", i))
            OUTPUTS[f"{way}_double_register_{i}"] = ("DOUBLE", one(f"double_{short}", i))


_add_registers()
