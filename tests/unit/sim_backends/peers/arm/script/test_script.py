"""The simulated controller's program memory without its network: pauses, safeguard, watchdog, outputs, other models."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams
from sim_backends.models.arm_kinematics import TABLES
from sim_backends.peers.arm.rtde.variables import Registers
from sim_backends.peers.arm.script.port import robot_mode, robot_state, version_message
from sim_backends.peers.arm.script.script import ProgramMemory, RuntimeState

TICK = 0.002
GOAL = [1.0, -1.57, -1.57, -1.57, 1.57, 0.0]
MOVE = f"def program():\n  movej({GOAL}, a=2.0, v=0.5)\nend\n"
SERVING = "def rtde_control():\n  global reg_offset_int = # int register offset\n 0\nend\n"
WATCHDOG = 35


class Controller:
    """A model, its program and their common tick."""

    def __init__(self) -> None:
        self.model = ArmModel(ArmParams(), np.random.default_rng(1), WorldClock())
        self.registers = Registers()
        self.program = ProgramMemory(self.model, self.registers)

    def run(self, seconds: float, held_up: bool = False) -> None:
        for _ in range(round(seconds / TICK)):
            self.program.tick(held_up)
            self.model.tick(self.model.time + TICK)

    def command(self, number: int, *values: float) -> None:
        self.registers.int_in[0] = number
        self.registers.double_in[: len(values)] = values
        self.registers.commands += 1

    @property
    def state(self) -> RuntimeState:
        return self.program.runtime_state

    @property
    def outputs(self) -> int:
        return self.model.digital_outputs


@pytest.fixture
def controller() -> Controller:
    return Controller()


@pytest.fixture
def moving(controller: Controller) -> Controller:
    controller.program.load(MOVE)
    controller.run(0.5)
    assert controller.model.moving
    return controller


def arrived(controller: Controller) -> bool:
    return bool(np.allclose(controller.model.drive.q, GOAL))


def test_a_pause_comes_to_rest_and_a_play_goes_on_to_the_old_target(moving: Controller) -> None:
    assert moving.program.pause()
    assert moving.state is RuntimeState.PAUSING
    moving.run(0.2)
    assert (moving.state, moving.model.moving) == (RuntimeState.PAUSED, False)
    moving.run(1.0)
    assert not moving.model.moving
    assert moving.program.play()
    moving.run(0.05)
    assert moving.state is RuntimeState.RESUMING
    moving.run(4.0)
    assert arrived(moving)


def test_a_safeguard_pauses_and_its_closing_resumes(moving: Controller) -> None:
    moving.model.fault("safeguard_stop")
    moving.run(0.3)
    assert (moving.state, moving.model.moving) == (RuntimeState.PAUSED, False)
    assert not moving.program.play()
    moving.model.clear()
    moving.run(4.0)
    assert arrived(moving)


@pytest.mark.parametrize("state", ["pausing", "paused", "resuming"])
def test_a_stop_ends_a_program_in_every_state_for_ever(moving: Controller, state: str) -> None:
    moving.program.pause()
    if state != "pausing":
        moving.run(0.3)
    if state == "resuming":
        moving.program.play()
        moving.run(0.02)
    moving.program.stop("test")
    moving.run(0.3)
    stands = moving.model.drive.q.copy()
    assert not moving.program.play()
    moving.run(1.0)
    assert np.array_equal(moving.model.drive.q, stands)


def watched(controller: Controller, frequency: float) -> None:
    controller.program.load(SERVING)
    controller.command(WATCHDOG, frequency)
    controller.run(0.01)
    controller.command(0)
    controller.run(0.01)
    assert controller.state is RuntimeState.PLAYING


def test_the_watchdog_ends_the_program_after_its_time_and_not_before(controller: Controller) -> None:
    watched(controller, 10.0)
    for _ in range(10):
        controller.run(0.09)
        controller.command(0)
    controller.run(0.098)
    assert controller.state is RuntimeState.PLAYING
    controller.run(0.006)
    assert controller.state is RuntimeState.STOPPED


def test_cycles_that_the_host_held_up_are_no_silence(controller: Controller) -> None:
    watched(controller, 10.0)
    controller.run(0.5, held_up=True)
    assert controller.state is RuntimeState.PLAYING
    controller.run(0.11)
    assert controller.state is RuntimeState.STOPPED


def secondary(*lines: str) -> str:
    return "sec outputs():\n" + "".join(f"  {line}\n" for line in lines) + "end\n"


def test_a_secondary_program_leaves_the_main_one_running(moving: Controller) -> None:
    moving.program.load(secondary("set_digital_out(3,True)"))
    assert moving.outputs == 1 << 3
    assert (moving.state, moving.model.moving) == (RuntimeState.PLAYING, True)
    moving.run(4.0)
    assert arrived(moving)


@pytest.mark.parametrize("line", ["movej([0,0,0,0,0,0])", "stopj(2)", "sleep(1)", "launch()"])
def test_a_secondary_program_that_takes_time_fails_and_the_main_one_outlives_it(moving: Controller, line: str) -> None:
    moving.program.load(secondary(line, "set_digital_out(3,True)"))
    assert "failed" in moving.program.message
    assert moving.outputs == 0
    moving.run(4.0)
    assert arrived(moving)


@pytest.mark.parametrize(("kind", "number", "bit"), [("standard", 2, 2), ("configurable", 1, 9), ("tool", 1, 17)])
def test_an_output_that_is_low_when_no_program_runs_cannot_be_raised_then(
    controller: Controller, kind: str, number: int, bit: int
) -> None:
    controller.program.load(secondary(f"set_runstate_{kind}_digital_output_to_value({number}, 1)"))
    controller.program.load(MOVE)
    both = 1 << bit | 1
    controller.model.write_digital_outputs(both, both)
    controller.run(0.5)
    assert controller.outputs == both
    controller.program.pause()
    controller.run(0.01)
    assert controller.outputs == 1, "low as soon as it pauses; others stay"
    controller.program.stop("test")
    controller.model.write_digital_outputs(both, both)
    controller.run(0.01)
    assert controller.outputs == 1
    controller.program.load(secondary(f"set_runstate_{kind}_digital_output_to_value({number}, 0)"))
    controller.model.write_digital_outputs(both, both)
    controller.run(0.01)
    assert controller.outputs == both, "kept, once that is asked for"


def test_the_other_choices_set_an_output_high(controller: Controller) -> None:
    controller.program.load(
        secondary(
            "set_runstate_standard_digital_output_to_value(0, 2)", "set_runstate_standard_digital_output_to_value(1, 3)"
        )
    )
    controller.run(0.01)
    assert controller.outputs == 0b01
    controller.program.load(MOVE)
    controller.run(0.1)
    assert controller.outputs == 0b11
    controller.program.stop("test")
    controller.run(0.01)
    assert controller.outputs == 0b01


def test_the_secondary_port_greets_with_packages_as_the_maker_describes_them(controller: Controller) -> None:
    greeting, mode = version_message((5, 15, 2, 7)), robot_mode(controller.model, 2)
    assert len(greeting) + len(mode) >= 79, "so much has to be read before the socket is closed"
    assert struct.unpack_from(">iB", greeting) == (len(greeting), 20)
    source, kind, length = struct.unpack_from(">bbb", greeting, 13)
    assert (source, kind) == (-2, 3)
    assert struct.unpack_from(">BBii", greeting, 16 + length) == (5, 15, 2, 7)
    assert struct.unpack_from(">iB", mode) == (len(mode), 16)
    assert struct.unpack_from(">IB", mode, 5) == (len(mode) - 5, 0)
    assert list(mode[18:25]) == [1, 1, 1, 0, 0, 1, 0], "powered, no stop, a program runs"
    assert mode[25] == 7


def test_every_model_tells_its_number() -> None:
    """UR7e and UR12e are told as what they were called before."""
    told = {}
    for name in TABLES:
        state = robot_state(ArmModel(ArmParams.of(name), np.random.default_rng(1), WorldClock()), 1, [0.0, 0.0])
        at = 5
        while state[at + 4] != 6:
            at += struct.unpack_from(">I", state, at)[0]
        told[name] = struct.unpack_from(">i", state, at + 445 - 8)[0]
    assert told == {
        "UR3": 3, "UR3e": 3, "UR5": 1, "UR5e": 1, "UR7e": 1, "UR10": 2, "UR10e": 2, "UR12e": 2, "UR16e": 4, "UR20": 7,
        "UR30": 8,
    }  # fmt: skip


def test_a_ur5e_stands_where_its_makers_table_says() -> None:
    model = ArmModel(ArmParams.of("UR5e"), np.random.default_rng(1), WorldClock())
    at_zero = model.kinematics.forward(np.zeros(6))[:3, 3]
    np.testing.assert_allclose(at_zero, [-(0.425 + 0.3922), -(0.1333 + 0.0996), 0.1625 - 0.0997], atol=1e-12)
    assert model.params.model == "UR5e"
