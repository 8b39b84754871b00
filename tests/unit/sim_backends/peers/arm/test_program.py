"""The program memory without its network: pauses, safeguard, watchdog, secondary programs, outputs."""

import numpy as np
import pytest

from sim_backends.peers.arm.program import RuntimeState
from tests.support.simulator.script_controller import Controller

GOAL = [1.0, -1.57, -1.57, -1.57, 1.57, 0.0]
MOVE = f"def program():\n  movej({GOAL}, a=2.0, v=0.5)\nend\n"
SERVING = "def rtde_control():\n  global reg_offset_int = # int register offset\n 0\nend\n"
WATCHDOG = 35


@pytest.fixture
def moving(controller: Controller) -> Controller:
    controller.program.load(MOVE)
    controller.run_for(0.5)
    assert controller.model.moving
    return controller


def arrived(controller: Controller) -> bool:
    return bool(np.allclose(controller.model.drive.q, GOAL))


def test_a_pause_comes_to_rest_and_a_play_goes_on_to_the_old_target(moving: Controller):
    assert moving.program.pause() and moving.state is RuntimeState.PAUSING
    moving.run_for(0.2)
    assert (moving.state, moving.model.moving) == (RuntimeState.PAUSED, False)
    moving.run_for(1.0)
    assert not moving.model.moving and moving.program.play()
    moving.run_for(0.05)
    assert moving.state is RuntimeState.RESUMING
    moving.run_for(4.0)
    assert arrived(moving)


def test_a_safeguard_pauses_and_its_closing_resumes(moving: Controller):
    moving.model.fault("safeguard_stop")
    moving.run_for(0.3)
    assert (moving.state, moving.model.moving) == (RuntimeState.PAUSED, False)
    assert not moving.program.play()
    moving.model.clear()
    moving.run_for(4.0)
    assert arrived(moving)


@pytest.mark.parametrize("state", ["pausing", "paused", "resuming"])
def test_a_stop_ends_a_program_in_every_state_for_ever(moving: Controller, state: str):
    moving.program.pause()
    if state != "pausing":
        moving.run_for(0.3)
    if state == "resuming":
        moving.program.play()
        moving.run_for(0.02)
    moving.program.stop("test")
    moving.run_for(0.3)
    stands = moving.model.drive.q.copy()
    assert not moving.program.play()
    moving.run_for(1.0)
    assert np.array_equal(moving.model.drive.q, stands)


def watched(controller: Controller, frequency: float) -> None:
    controller.program.load(SERVING)
    controller.command(WATCHDOG, frequency)
    controller.run_for(0.01)
    controller.command(0)
    controller.run_for(0.01)
    assert controller.state is RuntimeState.PLAYING


def test_the_watchdog_ends_the_program_after_its_time_and_not_before(controller: Controller):
    watched(controller, 10.0)
    for _ in range(10):
        controller.run_for(0.09)
        controller.command(0)
    controller.run_for(0.098)
    assert controller.state is RuntimeState.PLAYING
    controller.run_for(0.006)
    assert controller.state is RuntimeState.STOPPED


def test_cycles_that_the_host_held_up_are_no_silence(controller: Controller):
    watched(controller, 10.0)
    controller.run_for(0.5, held_up=True)
    assert controller.state is RuntimeState.PLAYING
    controller.run_for(0.11)
    assert controller.state is RuntimeState.STOPPED


def secondary(*lines: str) -> str:
    return "sec outputs():\n" + "".join(f"  {line}\n" for line in lines) + "end\n"


def test_a_secondary_program_leaves_the_main_one_running(moving: Controller):
    moving.program.load(secondary("set_digital_out(3,True)"))
    assert moving.outputs == 1 << 3
    assert (moving.state, moving.model.moving) == (RuntimeState.PLAYING, True)
    moving.run_for(4.0)
    assert arrived(moving)


@pytest.mark.parametrize("line", ["movej([0,0,0,0,0,0])", "stopj(2)", "sleep(1)", "launch()"])
def test_a_secondary_program_that_takes_time_fails_and_the_main_one_outlives_it(moving: Controller, line: str):
    moving.program.load(secondary(line, "set_digital_out(3,True)"))
    assert "failed" in moving.program.message
    assert moving.outputs == 0
    moving.run_for(4.0)
    assert arrived(moving)


@pytest.mark.parametrize(("kind", "number", "bit"), [("standard", 2, 2), ("configurable", 1, 9), ("tool", 1, 17)])
def test_an_output_that_is_low_when_no_program_runs_cannot_be_raised_then(
    controller: Controller, kind: str, number: int, bit: int
):
    controller.program.load(secondary(f"set_runstate_{kind}_digital_output_to_value({number}, 1)"))
    controller.program.load(MOVE)
    both = 1 << bit | 1
    controller.model.write_digital_outputs(both, both)
    controller.run_for(0.5)
    assert controller.outputs == both
    controller.program.pause()
    controller.run_for(0.01)
    assert controller.outputs == 1, "low as soon as it pauses; others stay"
    controller.program.stop("test")
    controller.model.write_digital_outputs(both, both)
    controller.run_for(0.01)
    assert controller.outputs == 1
    controller.program.load(secondary(f"set_runstate_{kind}_digital_output_to_value({number}, 0)"))
    controller.model.write_digital_outputs(both, both)
    controller.run_for(0.01)
    assert controller.outputs == both, "kept, once that is asked for"
