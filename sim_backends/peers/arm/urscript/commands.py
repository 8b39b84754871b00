"""URScript's commands of the arm and its controller: moves, questions, terminals, registers, payload, screen.

Source: the maker's script manual. A move that is asked to be faster than the joints can takes longer. Blend radii are
not modelled: the arm stops at every way point. Settings that change nothing in the simulated arm are taken and have no
effect.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sim_backends.models.arm import ArmModel, Safety
from sim_backends.models.arm_kinematics import Matrix, Vector, invert
from sim_backends.models.arm_motion import (
    ArcMove,
    ForceMode,
    JointMove,
    JointSpeed,
    LinearMove,
    LinearSpeed,
    Servo,
    StopMotion,
)
from sim_backends.peers.arm.commands import CYCLE, Job, ProgramError, tool_contact
from sim_backends.peers.arm.rtde.variables import REGISTERS
from sim_backends.peers.arm.urscript.environment import (
    Commands,
    Environment,
    InputWatchdog,
    List,
    ScriptPose,
    Value,
    as_pose,
    matrix,
    numbers,
    shown,
)


def commands(environment: Environment) -> Commands:
    """By name; those that take time are generator functions. Actual and target are one: the arm follows exactly."""
    arm = _Arm(environment)
    plain = {name: getattr(arm, name) for name in vars(_Arm) if not name.startswith("_")}
    others = {other: plain[name] for name, names in _OTHER_NAMES.items() for other in names.split()}
    parts = (_terminals, _registers, _screen, _settings)
    return {**plain, **others, **{name: act for part in parts for name, act in part(environment).items()}}


_OTHER_NAMES = {
    "get_actual_joint_positions": "get_joint_positions get_target_joint_positions",
    "get_actual_joint_speeds": "get_target_joint_speeds get_joint_speeds",
    "get_actual_tcp_pose": "get_target_tcp_pose get_tcp_pose get_target_waypoint",
    "get_actual_tool_flange_pose": "get_target_tool_flange_pose",
    "get_actual_tcp_speed": "get_target_tcp_speed",
    "get_target_payload": "get_target_payload_mass",
    "get_joint_temp": "get_controller_temp",
    "get_target_joint_accelerations": "get_target_payload_inertia",
}
_MOST_ACCELERATION = 8.0
"""rad/s², of which the moves that plan for themselves take a share."""
_RAMPS = 0.25
"""Share of a move of given time that it speeds up, and as much that it slows down."""


def _timed(length: float, t: float, speed: float, acceleration: float) -> tuple[float, float]:
    """Speed and acceleration of a move over `length`, which takes `t` s when that is not 0."""
    if t <= 0 or length <= 0:
        return speed, acceleration
    cruise = length / ((1 - _RAMPS) * t)
    return cruise, cruise / (_RAMPS * t)


class _Arm:
    """Commands that move the arm or ask it: its public methods and their parameters have the names of scripts."""

    def __init__(self, environment: Environment) -> None:
        self._e = environment

    @property
    def _model(self) -> ArmModel:
        return self._e.context.model

    def movej(self, q: List, a: float = 1.4, v: float = 1.05, t: float = 0, r: float = 0) -> Job:
        goal = self._joints(q)
        limit = self._model.params.joint_limit
        farthest = int(np.abs(goal).argmax())
        if abs(goal[farthest]) > limit:
            raise ProgramError(f"movej: joint {farthest} to {goal[farthest]:.6g} rad, its limit is {limit:.6g} rad")
        length = float(np.abs(goal - self._model.drive.q).max())
        yield from self._e.move(JointMove(goal, *_timed(length, t, v, a)))

    def movel(self, pose: List, a: float = 1.2, v: float = 0.25, t: float = 0, r: float = 0) -> Job:
        goal, here = self._tool(pose), self._model.drive.base_from_tcp()
        length = math.dist(goal[:3, 3], here[:3, 3])
        yield from self._e.move(LinearMove(goal, *_timed(length, t, v, a), slows=True))

    def movep(self, pose: List, a: float = 1.2, v: float = 0.25, r: float = 0) -> Job:
        yield from self.movel(pose, a, v)

    def movec(
        self, pose_via: List, pose_to: List, a: float = 1.2, v: float = 0.25, r: float = 0, mode: float = 0
    ) -> Job:
        yield from self._e.move(ArcMove(self._tool(pose_via)[:3, 3], self._tool(pose_to), v, a, fixed=mode == 1))

    def optimovej(self, q: List, a: float = 0.3, v: float = 0.3, r: float = 0) -> Job:
        """`a` and `v` are shares of the most."""
        yield from self.movej(q, a * _MOST_ACCELERATION, v * float(self._model.params.speed_limits.min()))

    def optimovel(self, pose: List, a: float = 0.3, v: float = 0.3, r: float = 0) -> Job:
        yield from self.movel(pose, 2.5 * a, v)

    def stopj(self, a: float = 2.0) -> Job:
        yield from self._e.move(StopMotion(a))

    def stopl(self, a: float = 1.2, aRot: float = 0) -> Job:
        yield from self._e.move(StopMotion(a, linear=True))

    def servoj(
        self, q: List, a: float = 0, v: float = 0, t: float = CYCLE, lookahead_time: float = 0.1, gain: float = 300
    ) -> Job:
        lag = max(self._model.params.tracking_lag, lookahead_time * 300.0 / max(gain, 1.0))
        motion, target = self._model.motion, self._joints(q)
        if isinstance(motion, Servo):
            motion.target, motion.lag = target, lag
        else:
            motion = Servo(target, lag)
        yield from self._e.stream(motion, t, lasting=True)

    def speedj(self, qd: List, a: float = 1.4, t: float = 0) -> Job:
        yield from self._speed(JointSpeed(_six(qd), a), t)

    def speedl(self, xd: List, a: float = 1.2, t: float = 0, aRot: float = 0) -> Job:
        yield from self._speed(LinearSpeed(_six(xd), a), t)

    def force_mode(self, task_frame: List, selection_vector: List, wrench: List, type: float, limits: List) -> None:
        self._e.force = ForceMode(matrix(task_frame), _six(selection_vector), _six(wrench), _six(limits))

    def end_force_mode(self) -> Job:
        if self._e.force is not None:
            self._e.force = None
            yield from self._e.move(StopMotion(10.0, linear=True))

    def tool_contact(self, direction: Sequence[Value] = (0.0,) * 6) -> int:
        return tool_contact(self._e.context, _six(direction))

    def sleep(self, t: float) -> Job:
        for _ in range(round(t / CYCLE)):
            yield

    def sync(self) -> Job:
        yield

    def get_actual_joint_positions(self) -> List:
        return numbers(self._model.drive.q)

    def get_actual_joint_speeds(self) -> List:
        return numbers(self._model.drive.qd)

    def get_target_joint_accelerations(self) -> List:
        return List([0.0] * 6)

    def get_actual_joint_positions_history(self, steps: int = 0) -> List:
        return numbers(self._e.context.joints_before(int(steps)))

    def get_joint_temp(self, joint: float = 0) -> float:
        return 30.0

    def get_tool_current(self) -> float:
        return 0.0

    def get_steptime(self) -> float:
        return CYCLE

    def is_steady(self) -> bool:
        return self._model.steady

    def is_within_safety_limits(self, q: List) -> bool:
        target = np.array(q if len(q) == 6 else [], float)
        return bool((np.abs(target) <= self._model.params.joint_limit).all())

    def is_robot_stopped(self) -> bool:
        return not self._model.moving

    def is_in_protective_stop(self) -> bool:
        return self._model.safety is Safety.PROTECTIVE_STOP

    def get_actual_tcp_pose(self) -> List:
        return as_pose(self._model.drive.base_from_tcp())

    def get_actual_tool_flange_pose(self) -> List:
        return as_pose(self._model.reported_flange())

    def get_actual_tcp_speed(self) -> List:
        return numbers(self._model.drive.tcp_jacobian().dot(self._model.drive.qd))

    def get_tcp_offset(self) -> List:
        return as_pose(self._model.drive.flange_from_tcp)

    def get_tcp_force(self) -> List:
        return numbers(self._model.felt)

    def force(self) -> float:
        return math.hypot(*self._model.felt[:3])

    def get_joint_torques(self) -> List:
        return numbers(self._model.drive.tcp_jacobian().T.dot(self._model.felt))

    def get_target_payload(self) -> float:
        return self._model.payload[0]

    def get_target_payload_cog(self) -> List:
        return numbers(self._model.payload[1])

    def get_inverse_kin(
        self, x: List, qnear: List | None = None, maxPositionError: float = 1e-10, maxOrientationError: float = 1e-10,
        tcp: List | None = None,
    ) -> List:  # fmt: skip
        target = matrix(x)
        if tcp is not None:
            target = target.dot(invert(matrix(tcp))).dot(self._model.drive.flange_from_tcp)
        return numbers(self._e.context.solve(target, None if qnear is None else np.array(qnear, float)))

    def get_inverse_kin_has_solution(
        self, x: List, qnear: List | None = None, *others: object, tcp: List | None = None
    ) -> bool:
        try:
            self.get_inverse_kin(x, qnear, tcp=tcp)
        except ProgramError:
            return False
        return True

    def get_forward_kin(self, q: List | None = None, tcp: List | None = None) -> List:
        drive = self._model.drive
        place: Matrix = self._model.kinematics.forward(drive.q if q is None else np.array(q, float))
        return as_pose(place.dot(drive.flange_from_tcp if tcp is None else matrix(tcp)))

    def _joints(self, target: List) -> Vector:
        return self._e.context.solve(matrix(target)) if isinstance(target, ScriptPose) else _six(target)

    def _tool(self, target: List) -> Matrix:
        return matrix(target) if isinstance(target, ScriptPose) else self._e.context.forward(_six(target))

    def _speed(self, wanted: JointSpeed | LinearSpeed, t: float) -> Job:
        motion = self._model.motion
        if isinstance(motion, JointSpeed | LinearSpeed) and type(motion) is type(wanted):
            motion.target, motion.acceleration = wanted.target, wanted.acceleration
        else:
            motion = wanted
        if not wanted.acceleration > 0:
            raise ProgramError(f"an acceleration of {wanted.acceleration:g} must be greater than 0")
        if t <= 0:
            # Until the speed is reached.
            gap = wanted.target - self._model.drive.qd if isinstance(wanted, JointSpeed) else wanted.target
            t = float(np.abs(gap).max()) / wanted.acceleration
        yield from self._e.stream(motion, t)


def _six(values: Sequence[Value]) -> Vector:
    array = np.array(values, float)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise ProgramError(f"{list(values)} are not six finite numbers")
    return array


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


def _settings(e: Environment) -> Commands:
    """Tool, payload, force sensor, and what has no effect."""
    return {
        **dict.fromkeys(_WITHOUT_EFFECT, lambda *values, **named: None),
        "set_tcp": lambda pose, tcp_name="": setattr(e.context.model.drive, "flange_from_tcp", matrix(pose)),
        "set_payload": lambda m, cog=None, inertia=None: _payload(e, m, cog),
        "set_target_payload": lambda m, cog=None, inertia=None, transition_time=0: _payload(e, m, cog),
        "set_payload_mass": lambda m: _payload(e, m, None),
        "set_payload_cog": lambda cog: _payload(e, e.context.model.payload[0], cog),
        "zero_ftsensor": lambda: e.context.model.zero_force(),
        "protective_stop": lambda: e.context.model.protective_stop("triggered by the program"),
    }


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
