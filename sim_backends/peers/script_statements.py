"""The few statements of URScript that clients upload beside the control script: moves, stops, outputs, progress.

Blend radii are not modelled: the arm stops at every way point.
"""

from __future__ import annotations

import re

import numpy as np

from sim_backends.models.arm_kinematics import matrix_from_pose
from sim_backends.models.arm_motion import JointMove, LinearMove, Stop
from sim_backends.peers.script_context import Context, Job

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_STATEMENT = re.compile(r"^\s*(\w+)\((.*)\)\s*$")
_NUMBERS_NEEDED = {
    "movej": 6,
    "movel": 6,
    "movep": 6,
    "stopj": 1,
    "stopl": 1,
    "signal_async_progress": 1,
    "write_output_integer_register": 2,
    "set_digital_out": 1,
    "set_standard_digital_out": 1,
    "textmsg": 0,
}
_DEFAULTS = {"movej": (1.05, 1.4), "movel": (0.25, 1.2), "movep": (0.25, 1.2)}


def statements(text: str) -> list[str]:
    """The lines of a program that do something."""
    lines = [line.strip() for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith(("#", "def ", "sec ")) and line != "end"]


def path_statements(text: str) -> list[str]:
    """The statements that a client has put into the control script's `exec_move_path`."""
    match = re.search(r"def exec_move_path\(\):\n(.*?)\n\s*end\b", text, re.DOTALL)
    return statements(match[1]) if match else []


def understood(line: str) -> bool:
    """Whether `run_statement` can carry out this line."""
    match = _STATEMENT.match(line)
    needed = _NUMBERS_NEEDED.get(match[1]) if match else None
    return match is not None and needed is not None and len(re.findall(_NUMBER, match[2])) >= needed


def run_statement(c: Context, line: str) -> Job:
    """Carry out one understood statement."""
    match = _STATEMENT.match(line)
    assert match is not None
    name, arguments = match[1], match[2]
    numbers = [float(number) for number in re.findall(_NUMBER, arguments)]
    if name in _DEFAULTS:
        options = {key: float(value) for key, value in re.findall(rf"\b([av])\s*=\s*({_NUMBER})", arguments)}
        speed, acceleration = options.get("v", _DEFAULTS[name][0]), options.get("a", _DEFAULTS[name][1])
        goal, is_pose = np.array(numbers[:6]), arguments.lstrip().startswith("p")
        if name == "movej":
            joints = c.solve(matrix_from_pose(goal)) if is_pose else goal
            yield from c.wait(JointMove(joints, speed, acceleration))
        else:
            pose = matrix_from_pose(goal) if is_pose else c.forward(goal)
            yield from c.wait(LinearMove(pose, speed, acceleration))
    elif name in ("stopj", "stopl"):
        yield from c.wait(Stop(numbers[0], linear=name == "stopl"))
    elif name == "signal_async_progress":
        c.signal_async(int(numbers[0]))
    elif name == "write_output_integer_register":
        # ur_rtde writes the register as a sum of its number and the offset.
        c.registers.int_out[int(sum(numbers[:-1])) % len(c.registers.int_out)] = int(numbers[-1])
    elif name in ("set_digital_out", "set_standard_digital_out"):
        bit = 1 << (int(numbers[0]) & 7)
        c.model.write_digital_outputs(bit, bit if "True" in arguments else 0)
