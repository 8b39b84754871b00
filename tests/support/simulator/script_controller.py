"""A simulated arm, its program memory and their common tick, without a network."""

import numpy as np

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams
from sim_backends.peers.arm.program import ProgramMemory, RuntimeState
from sim_backends.peers.arm.rtde.variables import Registers

TICK = 0.002


class Controller:
    """A controller whose cycles a test counts."""

    def __init__(self) -> None:
        self.model = ArmModel(ArmParams(), np.random.default_rng(1), WorldClock())
        self.registers = Registers()
        self.program = ProgramMemory(self.model, self.registers)

    def cycles(self, count: int, held_up: bool = False) -> None:
        for _ in range(count):
            self.program.tick(held_up)
            self.model.tick(self.model.time + TICK)

    def run_for(self, seconds: float, held_up: bool = False) -> None:
        self.cycles(round(seconds / TICK), held_up)

    def run(self, text: str, most: int = 3000) -> None:
        """Run a program to its end."""
        self.program.load(text)
        for _ in range(most):
            if self.program.runtime_state is RuntimeState.STOPPED:
                return
            self.cycles(1)
        raise AssertionError("the program did not end")

    def command(self, number: int, *values: float) -> None:
        """What ur_rtde writes to give a command."""
        self.registers.int_in[0] = number
        self.registers.double_in[: len(values)] = values
        self.registers.commands += 1

    @property
    def state(self) -> RuntimeState:
        return self.program.runtime_state

    @property
    def outputs(self) -> int:
        return self.model.digital_outputs

    def said(self) -> list[str]:
        """What the program has written for the log."""
        return [one.words for one in self.program.announcements if one.kind == "text"]

    def failed(self) -> list[str]:
        return [one.words for one in self.program.announcements if one.kind == "failed"]


def program(*lines: str) -> str:
    """A program of these lines."""
    return "def program():\n" + "".join(f"  {line}\n" for line in lines) + "end\n"
