"""URScript's commands for inputs, outputs, registers, the tool, the payload and the operator's screen.

Source: the maker's script manual. Settings that change nothing in the simulated arm are taken and have no effect.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sim_backends.peers.arm.rtde.variables import REGISTERS
from sim_backends.peers.arm.script.context import Job, ProgramError
from sim_backends.peers.arm.urscript.environment import Commands, Environment, InputWatchdog, List, Value, matrix, shown

_KINDS = {"standard": (0, 8), "configurable": (8, 8), "tool": (16, 2)}
"""First bit and number of the digital inputs and outputs of each kind."""
_WITHOUT_EFFECT = (
    "set_gravity", "set_tool_voltage", "set_tool_digital_output_mode", "set_tool_output_mode", "set_tool_communication",
    "set_analog_inputrange", "set_standard_analog_input_domain", "set_tool_analog_input_domain",
    "set_analog_outputdomain",
    "set_input_actions_to_default", "set_standard_digital_input_action", "set_configurable_digital_input_action",
    "set_tool_digital_input_action", "set_gp_boolean_input_action", "set_runstate_gp_boolean_output_to_value",
    "set_runstate_standard_analog_output_to_value", "set_safety_mode_transition_hardness", "set_conveyor_tick_count",
    "force_mode_set_damping", "force_mode_set_gain_scaling", "freedrive_mode", "end_freedrive_mode", "teach_mode",
    "end_teach_mode", "freedrive_mode_no_incorrect_payload_check", "ft_rtde_input_enable", "enable_external_ft_sensor",
    "request_boolean_from_primary_client", "set_flag", "set_joint_friction_compensation", "set_friction_compensation",
    "set_eoat", "reset_world_model", "reset_revolution_counter",
)  # fmt: skip
"""Each has what it sets in something that the simulated arm has not."""


def commands(environment: Environment) -> Commands:
    """By name; those that take time are generator functions."""
    e = environment
    return {
        **_terminals(e),
        **_registers(e),
        **_screen(e),
        **dict.fromkeys(_WITHOUT_EFFECT, _no_effect),
        "set_tcp": lambda pose, tcp_name="": setattr(e.context.model.drive, "flange_from_tcp", matrix(pose)),
        "set_payload": lambda m, cog=None, inertia=None: _payload(e, m, cog),
        "set_target_payload": lambda m, cog=None, inertia=None, transition_time=0: _payload(e, m, cog),
        "set_payload_mass": lambda m: _payload(e, m, None),
        "set_payload_cog": lambda cog: _payload(e, e.context.model.payload[0], cog),
        "zero_ftsensor": lambda: e.context.model.zero_force(),
        "protective_stop": lambda: e.context.model.protective_stop("triggered by the program"),
    }


def _no_effect(*values: object, **named: object) -> None:
    pass


def _payload(e: Environment, mass: float, cog: List | None) -> None:
    if not 0 <= mass <= 1000:
        raise ProgramError(f"a payload of {mass:g} kg")
    centre = e.context.model.payload[1] if cog is None else np.array(cog, float)
    e.context.model.payload = (float(mass), centre)


def _terminals(e: Environment) -> Commands:
    def place(kind: str, number: float) -> int:
        first, count = _KINDS[kind]
        if not 0 <= number < count:
            raise ProgramError(f"there is no {kind} terminal {shown(number)}")
        return first + int(number)

    def setter(kind: str) -> Callable[..., None]:
        def set_output(n: float, b: Value) -> None:
            bit = 1 << place(kind, n)
            e.context.model.write_digital_outputs(bit, bit if b else 0)

        return set_output

    def reader(kind: str, outputs: bool) -> Callable[[float], bool]:
        def read(n: float) -> bool:
            model = e.context.model
            return bool((model.digital_outputs if outputs else model.digital_inputs) >> place(kind, n) & 1)

        return read

    def held(kind: str) -> Callable[[float, float], None]:
        return lambda outputId, state: e.outputs.choose(place(kind, outputId), int(state))

    def set_digital_out(n: float, b: Value) -> None:
        """The old numbering: 8 and 9 are the tool's."""
        kind, number = ("tool", n - 8) if n in (8, 9) else ("standard", n)
        setter(kind)(number, b)

    def get_digital_in(n: float) -> bool:
        kind, number = ("tool", n - 8) if n in (8, 9) else ("standard", n)
        return reader(kind, outputs=False)(number)

    def set_analog(n: float, f: float) -> None:
        if n not in (0, 1) or not 0 <= f <= 1:
            raise ProgramError(f"analog output {shown(n)} cannot be {shown(f)}")
        e.context.registers.analog_out[int(n)] = float(f)

    found: dict[str, Callable[..., object]] = {
        "set_digital_out": set_digital_out, "get_digital_in": get_digital_in,
        "get_digital_out": lambda n: reader("standard", outputs=True)(n),
        "set_analog_out": set_analog, "set_standard_analog_out": set_analog,
        "get_analog_in": lambda n: 0.0, "get_standard_analog_in": lambda n: 0.0, "get_tool_analog_in": lambda n: 0.0,
        "get_analog_out": lambda n: e.context.registers.analog_out[int(n)],
        "get_standard_analog_out": lambda n: e.context.registers.analog_out[int(n)],
    }  # fmt: skip
    for kind in _KINDS:
        found[f"set_{kind}_digital_out"] = setter(kind)
        found[f"get_{kind}_digital_out"] = reader(kind, outputs=True)
        found[f"get_{kind}_digital_in"] = reader(kind, outputs=False)
        found[f"set_runstate_{kind}_digital_output_to_value"] = held(kind)
    return found


def _registers(e: Environment) -> Commands:
    def reader(bank: str, count: int = REGISTERS) -> Callable[[float], object]:
        return lambda address: getattr(e.context.registers, bank)[_address(address, count)]

    def writer(bank: str, make: Callable[[Any], object], count: int = REGISTERS) -> Callable[[float, Value], None]:
        def write(address: float, value: Value) -> None:
            getattr(e.context.registers, bank)[_address(address, count)] = make(value)

        return write

    def set_watchdog(variableName: str, minFrequency: float, action: str = "pause") -> None:
        registers = e.context.registers
        registers.written.setdefault(variableName, 0)

        def fail() -> None:
            raise ProgramError(f"watchdog: {variableName} was not written to at {minFrequency:g} Hz")

        acts: dict[str, Callable[[], object]] = {"ignore": lambda: None, "pause": e.pause, "stop": fail}
        act = acts.get(action.lower())
        if act is None or not minFrequency > 0:
            raise ProgramError(f"rtde_set_watchdog: {action!r} at {minFrequency:g} Hz")
        e.watches.append(InputWatchdog(1.0 / minFrequency, lambda: registers.written[variableName], act))

    return {
        "read_input_integer_register": reader("int_in"),
        "read_input_float_register": reader("double_in"),
        "read_input_boolean_register": reader("bits_in", 128),
        "read_output_integer_register": reader("int_out"),
        "read_output_float_register": reader("double_out"),
        "read_output_boolean_register": reader("bits_out", 128),
        "write_output_integer_register": writer("int_out", int),
        "write_output_float_register": writer("double_out", float),
        "write_output_boolean_register": writer("bits_out", bool, 128),
        "rtde_set_watchdog": set_watchdog,
        # Of ur_rtde's own script, which calls it on its paths.
        "signal_async_progress": lambda progress: e.context.signal_async(int(progress)),
    }


def _screen(e: Environment) -> Commands:
    def textmsg(s1: Value, s2: Value = "") -> None:
        e.announce("text", shown(s1) + shown(s2))

    def popup(
        s: Value, title: str = "Popup", warning: bool = False, error: bool = False, blocking: bool = False
    ) -> Job:
        e.announce("popup", f"{title}: {shown(s)}")
        e.popup_open = bool(blocking)
        while e.popup_open:
            yield

    return {"textmsg": textmsg, "popup": popup}


def _address(address: float, count: int) -> int:
    if not 0 <= address < count or int(address) != address:
        raise ProgramError(f"register {shown(address)} does not exist: 0 to {count - 1}")
    return int(address)
