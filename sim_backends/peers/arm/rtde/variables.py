"""Every variable that RTDE can read or write, by name, and the recipes of which a data packet carries.

Names and types follow the maker's RTDE guide. What the simulated arm has nothing of, currents, temperatures, the tool's
connector, is zero or a usual value.
"""

import math
import re
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

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
        self.analog_out = [0.0, 0.0]
        self.written: dict[str, int] = {}
        """How often clients have written to the inputs that a program watches."""


_SAFETY_BITS = {
    1: 1 << 0, 2: 1 << 1, Safety.PROTECTIVE_STOP.value: 1 << 2 | 1 << 10,
    Safety.SAFEGUARD_STOP.value: 1 << 4 | 1 << 10, Safety.EMERGENCY_STOP.value: 1 << 6 | 1 << 7 | 1 << 10,
}  # fmt: skip
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


FORMATS = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d", "VECTOR3D": "3d",
    "VECTOR6D": "6d", "VECTOR6INT32": "6i",
}  # fmt: skip
"""`struct` code of every RTDE type; numbers are big-endian on the wire."""

Getter = Callable[[RegisterView], Iterable[float]]


def _always(*values: float) -> Getter:
    return lambda view: values


_SIX = _always(*[0.0] * 6)
_THREE = _always(*[0.0] * 3)
_ZERO = _always(0)

_STILL: dict[tuple[str, Getter], str] = {
    ("VECTOR6D", _SIX): (
        "target_qdd target_current target_moment actual_current actual_current_window "
        "actual_current_as_torque joint_control_output actual_TCP_acceleration target_TCP_acceleration "
        "wrench_calc_from_currents payload_inertia target_base_acceleration target_base_wrench"
    ),
    ("DOUBLE", _ZERO): (
        "actual_execution_time target_execution_time actual_robot_energy_consumed "
        "actual_robot_braking_energy_dissipated standard_analog_input0 standard_analog_input1 io_current "
        "euromap67_24V_voltage euromap67_24V_current tool_analog_input0 tool_analog_input1 "
        "tool_output_current joint_position_deviation_ratio collision_detection_ratio"
    ),
    ("VECTOR3D", _THREE): "actual_tool_accelerometer elbow_position elbow_velocity",
    ("UINT32", _ZERO): (
        "analog_io_types euromap67_input_bits euromap67_output_bits tool_analog_input_types script_control_line"
    ),
    ("INT32", _ZERO): "tool_output_voltage time_scale_source encoder0_raw encoder1_raw",
    ("UINT8", _ZERO): "tool_output_mode tool_digital_output0_mode tool_digital_output1_mode",
}
"""What never changes: type and value, and the names of all that are so."""

OUTPUTS: dict[str, tuple[str, Getter]] = {
    **{name: still for still, names in _STILL.items() for name in names.split()},
    "timestamp": ("DOUBLE", lambda v: (v.model.time,)),
    "target_q": ("VECTOR6D", lambda v: v.model.drive.q.tolist()),
    "target_qd": ("VECTOR6D", lambda v: v.model.drive.qd.tolist()),
    "actual_q": ("VECTOR6D", lambda v: v.model.drive.q.tolist()),
    "actual_qd": ("VECTOR6D", lambda v: v.model.drive.qd.tolist()),
    "actual_TCP_pose": ("VECTOR6D", RegisterView.tcp_pose),
    "actual_TCP_speed": ("VECTOR6D", RegisterView.tcp_speed),
    "actual_TCP_force": ("VECTOR6D", lambda v: v.model.felt.tolist()),
    "target_TCP_pose": ("VECTOR6D", RegisterView.tcp_pose),
    "target_TCP_speed": ("VECTOR6D", RegisterView.tcp_speed),
    "tcp_offset": ("VECTOR6D", RegisterView.tcp_offset),
    "actual_digital_input_bits": ("UINT64", lambda v: (v.model.digital_inputs,)),
    "actual_configurable_digital_input_bits": ("UINT64", lambda v: (v.model.digital_inputs >> 8 & 255,)),
    "joint_temperatures": ("VECTOR6D", _always(*[30.0] * 6)),
    "robot_mode": ("INT32", lambda v: (int(v.model.power),)),
    "joint_mode": ("VECTOR6INT32", lambda v: [253 if v.model.power is Power.RUNNING else 239] * 6),
    "safety_mode": ("INT32", lambda v: (v.model.safety_mode,)),
    "safety_status": ("INT32", lambda v: (v.model.safety_mode,)),
    "speed_scaling": ("DOUBLE", lambda v: (v.model.drive.speed_fraction,)),
    "target_speed_fraction": ("DOUBLE", lambda v: (v.model.drive.speed_fraction,)),
    "actual_momentum": ("DOUBLE", lambda v: (5.0 * math.hypot(*v.tcp_speed()[:3]),)),
    "actual_main_voltage": ("DOUBLE", _always(48.0)),
    "actual_robot_voltage": ("DOUBLE", lambda v: (48.0 if v.model.power is not Power.OFF else 0.0,)),
    "actual_robot_current": ("DOUBLE", _always(0.5)),
    "actual_joint_voltage": ("VECTOR6D", _always(*[48.0] * 6)),
    "actual_digital_output_bits": ("UINT64", lambda v: (v.model.digital_outputs,)),
    "actual_configurable_digital_output_bits": ("UINT64", lambda v: (v.model.digital_outputs >> 8 & 255,)),
    "runtime_state": ("UINT32", lambda v: (v.runtime_state,)),
    "robot_status_bits": ("UINT32", lambda v: (v.robot_bits(),)),
    "safety_status_bits": ("UINT32", lambda v: (v.safety_bits(),)),
    "standard_analog_output0": ("DOUBLE", lambda v: (v.registers.analog_out[0],)),
    "standard_analog_output1": ("DOUBLE", lambda v: (v.registers.analog_out[1],)),
    "tool_mode": ("UINT32", lambda v: (253 if v.model.power is Power.RUNNING else 239,)),
    "tool_temperature": ("DOUBLE", _always(30.0)),
    "tcp_force_scalar": ("DOUBLE", lambda v: (math.hypot(*v.model.felt[:3]),)),
    "ft_raw_wrench": ("VECTOR6D", RegisterView.raw_wrench),
    "payload": ("DOUBLE", lambda v: (v.model.payload[0],)),
    "payload_cog": ("VECTOR3D", lambda v: v.model.payload[1].tolist()),
    "target_gravity": ("VECTOR3D", _always(0.0, 0.0, 9.82)),
    "control_step": ("UINT64", lambda v: (round(v.model.time * 500.0),)),
}
"""Readable variables: type and how to read it. The registers are added below."""

_WRITTEN = {
    "UINT32": "speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63",
    "DOUBLE": "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    "UINT8": (
        "standard_digital_output_mask standard_digital_output configurable_digital_output_mask "
        "configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask "
        "standard_analog_output_type"
    ),
    "VECTOR6D": "external_force_torque",
}
INPUTS: dict[str, str] = {
    **{name: kind for kind, names in _WRITTEN.items() for name in names.split()},
    **{f"input_bit_register_{i}": "BOOL" for i in range(64, BITS)},
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}


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


_COMMANDS = frozenset({"input_int_register_0", "input_int_register_24"})
_BANKS = {"int": "int_in", "double": "double_in", "bit": "bits_in"}
_REGISTER = re.compile(r"input_(int|double|bit)_register_(\d+)")


class InputRecipe:
    """The variables that one kind of data packet carries, in order."""

    def __init__(self, names: list[str], model: ArmModel, registers: Registers) -> None:
        """`names` are keys of `INPUTS`."""
        self._model = model
        self._registers = registers
        self._names = frozenset(names)
        self._unpacker = struct.Struct(">" + "".join(FORMATS[INPUTS[name]] for name in names))
        self._slots: list[tuple[list[int] | list[float] | list[bool], int]] = []
        self._others: list[tuple[str, int]] = []
        place = 0
        for name in names:
            match = _REGISTER.fullmatch(name)
            if match is None:
                self._others.append((name, place))
                self._slots += [([0.0], 0)] * (6 if INPUTS[name] == "VECTOR6D" else 1)
            else:
                self._slots.append((getattr(registers, _BANKS[match[1]]), int(match[2])))
            place = len(self._slots)

    def apply(self, payload: bytes) -> None:
        """Write one packet's values; real clients send packets too long or too short, which are cut or padded."""
        size = self._unpacker.size
        numbers = self._unpacker.unpack(payload if len(payload) == size else payload[:size].ljust(size, b"\0"))
        for (bank, index), number in zip(self._slots, numbers, strict=True):
            bank[index] = number
        if self._names & _COMMANDS:
            self._registers.commands += 1
            self._registers.command_fields = self._names
        for name in self._registers.written.keys() & self._names:
            self._registers.written[name] += 1
        if self._others:
            self._write_outputs({name: numbers[place] for name, place in self._others})

    def _write_outputs(self, values: dict[str, float]) -> None:
        """Masked outputs change only where their mask says so."""
        for kind, first, bits in (("standard", 0, 255), ("configurable", 8, 255), ("tool", 16, 3)):
            mask = int(values.get(f"{kind}_digital_output_mask", 0)) & bits
            levels = int(values.get(f"{kind}_digital_output", 0))
            if mask:
                self._model.write_digital_outputs(mask << first, levels << first)
        if int(values.get("speed_slider_mask", 0)) & 1:
            self._model.drive.speed_fraction = min(1.0, max(0.0, values.get("speed_slider_fraction", 1.0)))
        for first in (0, 32):
            if (name := f"input_bit_registers{first}_to_{first + 31}") in values:
                bits = int(values[name])
                self._registers.bits_in[first : first + 32] = [bool(bits >> bit & 1) for bit in range(32)]
        mask = int(values.get("standard_analog_output_mask", 0))
        for i in (0, 1):
            if mask >> i & 1:
                self._registers.analog_out[i] = values.get(f"standard_analog_output_{i}", 0.0)


@dataclass(frozen=True)
class OutputRecipe:
    """The variables that are sent in every `every`-th tick under recipe `number`, 0 for protocol 1, which has none."""

    number: int
    every: int
    packer: struct.Struct
    getters: tuple[Getter, ...]

    def packet(self, view: RegisterView) -> bytes:
        """One data packet."""
        values: list[float] = []
        for getter in self.getters:
            values += getter(view)
        head = (self.number,) if self.number else ()
        return self.packer.pack(self.packer.size, ord("U"), *head, *values)
