"""RTDE to the byte, for clients that are not ours."""

import struct
from itertools import pairwise

import pytest

from tests.support.simulator.rtde_client import Rtde

pytestmark = pytest.mark.wire


NUMBERED = ("int_register", "double_register")


NAMES = [
    "timestamp", "target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd",
    "actual_current", "joint_control_output", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force",
    "target_TCP_pose", "target_TCP_speed", "actual_digital_input_bits", "joint_temperatures", "actual_execution_time",
    "robot_mode", "joint_mode", "safety_status", "actual_tool_accelerometer", "speed_scaling", "target_speed_fraction",
    "actual_momentum", "actual_main_voltage", "actual_robot_voltage", "actual_robot_current", "actual_joint_voltage",
    "actual_digital_output_bits", "runtime_state", "joint_position_deviation_ratio", "payload", "payload_cog",
    "payload_inertia", "ft_raw_wrench", "script_control_line", "actual_current_window", "elbow_position",
    "elbow_velocity", "robot_status_bits", "safety_status_bits", "safety_mode", "io_current", "tool_mode",
    "tcp_force_scalar", "tcp_offset", "analog_io_types", "standard_analog_input0", "standard_analog_input1",
    "standard_analog_output0", "standard_analog_output1", "tool_analog_input_types", "tool_analog_input0",
    "tool_analog_input1", "tool_output_voltage", "tool_output_current", "tool_temperature", "tool_output_mode",
    "tool_digital_output0_mode", "tool_digital_output1_mode", "euromap67_input_bits", "euromap67_output_bits",
    "euromap67_24V_voltage", "euromap67_24V_current", "actual_configurable_digital_input_bits",
    "actual_configurable_digital_output_bits", "encoder0_raw", "encoder1_raw",
    *(f"{way}_bit_registers{bits}" for way in ("input", "output") for bits in ("0_to_31", "32_to_63")),
    *(f"{way}_bit_register_{i}" for way in ("input", "output") for i in range(64, 128)),
    *(f"{way}_{kind}_{i}" for way in ("input", "output") for kind in NUMBERED for i in range(48)),
]  # fmt: skip
"""The 393 outputs that the maker's own recording example can ask for."""


SIZES = {
    "BOOL": 1, "UINT8": 1, "UINT32": 4, "UINT64": 8, "INT32": 4, "DOUBLE": 8, "VECTOR3D": 24, "VECTOR6D": 48,
    "VECTOR6INT32": 24,
}  # fmt: skip


def test_every_documented_output_is_sent_with_its_type(address: str):
    assert len(NAMES) == 393
    client = Rtde(address)
    reply = client.ask("O", struct.pack(">d", 500.0) + ",".join(NAMES).encode())
    kinds = reply[1:].decode().split(",")
    assert reply[0] == 1
    types = dict(zip(NAMES, kinds, strict=True))
    assert (types["tool_output_mode"], types["tool_mode"], types["tool_output_voltage"]) == ("UINT8", "UINT32", "INT32")
    assert (types["joint_mode"], types["output_bit_register_64"]) == ("VECTOR6INT32", "BOOL")
    client.ask("S")
    (state,) = client.states(1)
    assert len(state) == 1 + sum(SIZES[kind] for kind in kinds)


def test_an_unknown_name_is_not_found_and_an_input_that_another_writes_is_in_use_until_it_leaves(address: str):
    first, second = Rtde(address), Rtde(address)
    assert first.ask("O", struct.pack(">d", 125.0) + b"timestamp,joint_gossip") == b"\0DOUBLE,NOT_FOUND"
    assert first.ask("I", b"input_bit_register_64,input_bit_registers0_to_31") == b"\1BOOL,UINT32"
    assert second.ask("I", b"input_int_register_5,input_bit_register_64,nonsense") == b"\0INT32,IN_USE,NOT_FOUND"
    first.socket.close()
    for _ in range(100):
        if second.ask("I", b"input_bit_register_64") == b"\1BOOL":
            return
    raise AssertionError("the input was not given back")


def test_inputs_of_every_kind_come_back_as_outputs(address: str):
    client = Rtde(address)
    names = "input_bit_registers0_to_31,input_bit_register_70,input_int_register_40,input_double_register_41"
    assert client.ask("I", names.encode()) == b"\1UINT32,BOOL,INT32,DOUBLE"
    client.notify(struct.pack(">BI?id", 1, 0x80000005, True, -7, 2.5))
    client.ask("O", struct.pack(">d", 500.0) + names.encode())
    client.ask("S")
    assert struct.unpack(">BI?id", client.states(4)[-1]) == (1, 0x80000005, True, -7, 2.5)


def test_receivers_have_rates_of_their_own_and_version_1_has_no_recipe_numbers(address: str):
    fast, slow, old = Rtde(address), Rtde(address), Rtde(address, version=1)
    fast.ask("O", struct.pack(">d", 500.0) + b"timestamp")
    slow.ask("O", struct.pack(">d", 25.0) + b"timestamp,actual_q")
    assert old.ask("O", b"timestamp,robot_mode") == b"DOUBLE,INT32"
    for client, steps, code in ((fast, 0.002, ">Bd"), (slow, 0.04, ">Bd6d"), (old, 0.002, ">di")):
        client.ask("S")
        stamps = [struct.unpack(code, state)[code.startswith(">B")] for state in client.states(5)]
        assert client.ask("P") == b"\1"
        assert [b - a for a, b in pairwise(stamps)] == pytest.approx([steps] * 4, abs=1e-6)
    assert old.ask("I", b"input_int_register_30") == b"INT32"
