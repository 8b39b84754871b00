"""Digital outputs that the controller sets by itself while no program runs, and secondary programs, which set this up.

Source: the script manual, `set_runstate_standard_digital_output_to_value` and its like for the other outputs, and its
chapter on secondary programs.
"""

from __future__ import annotations

import re

from sim_backends.models.arm import ArmModel
from sim_backends.peers.script_context import Context
from sim_backends.peers.script_statements import run_statement, statements, understood

_KEEP, _LOW, _HIGH, _HIGH_ONLY_WHILE_RUNNING = range(4)
_SETTING = re.compile(
    r"^\s*set_runstate_(standard|configurable|tool)_digital_output_to_value\(\s*(\d+)\s*,\s*([0-3])\s*\)\s*$"
)
_KINDS = {"standard": (0, 8), "configurable": (8, 8), "tool": (16, 2)}
"""First bit and number of the digital outputs of each kind."""


class HeldOutputs:
    """What each output does while no program runs; such a setting outlives programs until it is changed."""

    def __init__(self, model: ArmModel) -> None:
        self._model = model
        self._choices: dict[int, int] = {}

    def hold(self, running: bool) -> None:
        """One cycle: set what is to be set. A paused program does not run."""
        for index, choice in self._choices.items():
            if not running or choice == _HIGH_ONLY_WHILE_RUNNING:
                level = running or choice == _HIGH
                self._model.write_digital_outputs(1 << index, int(level) << index)

    def run_secondary(self, context: Context, text: str) -> str:
        """Carry out a secondary program beside the main one; the line at which it failed, empty if it did not.

        It may only do what takes no time, so no moves and stops.
        """
        for line in statements(text):
            if (match := _SETTING.match(line)) is not None:
                first, count = _KINDS[match[1]]
                index, choice = int(match[2]), int(match[3])
                if index >= count:
                    return line
                self._choices.pop(first + index, None)
                if choice != _KEEP:
                    self._choices[first + index] = choice
            elif line.startswith(("move", "stop")) or not understood(line):
                return line
            else:
                next(run_statement(context, line), None)
        return ""
