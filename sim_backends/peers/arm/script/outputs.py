"""Digital outputs that the controller sets by itself while no program runs.

Source: the script manual, `set_runstate_standard_digital_output_to_value` and its like for the other outputs.
"""

from __future__ import annotations

from sim_backends.models.arm import ArmModel

_KEEP, _, _HIGH, _HIGH_ONLY_WHILE_RUNNING = range(4)


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

    def choose(self, index: int, choice: int) -> None:
        """What output `index` does while no program runs: 0 stays, 1 low, 2 high, 3 high only while one does.

        Raises ValueError for another choice.
        """
        if choice not in range(4):
            raise ValueError(f"a choice of {choice}, 0 to 3 are known")
        self._choices.pop(index, None)
        if choice != _KEEP:
            self._choices[index] = choice
