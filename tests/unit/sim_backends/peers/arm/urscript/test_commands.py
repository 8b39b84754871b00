"""URScript's commands that move the arm and ask it."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_backends.peers.arm.program import RuntimeState
from tests.support.simulator.script_controller import Controller, program


def test_moves_arrive_in_the_time_they_are_given(controller: Controller):
    goal = [0.3, -1.5, -1.6, -1.5, 1.5, 0.1]
    controller.program.load(program(f"movej({goal}, t=1.0)", "write_output_integer_register(0, 1)"))
    controller.cycles(495)
    assert controller.registers.int_out[0] == 0
    controller.cycles(10)
    assert controller.registers.int_out[0] == 1
    np.testing.assert_allclose(controller.model.drive.q, goal, atol=1e-9)
    before = controller.model.drive.base_from_tcp()
    controller.run(program("movel(pose_add(get_actual_tcp_pose(), p[0, 0, -0.05, 0, 0, 0]), v=0.1)"))
    way = controller.model.drive.base_from_tcp()[:3, 3] - before[:3, 3]
    np.testing.assert_allclose(way, [0, 0, -0.05], atol=1e-6)


@pytest.mark.parametrize("mode", [0, 1])
def test_a_circle_goes_past_its_via_point_and_on_after_a_pause(controller: Controller, mode: int):
    """Three quarters of a circle of 50 mm round a centre below the tool, in a plane that leans."""
    model = controller.model
    start = model.drive.base_from_tcp()
    across, down = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, -1.0])
    centre = start[:3, 3] + 0.05 * down

    def on_circle(angle: float) -> str:
        x, y, z = centre + 0.05 * (math.sin(angle) * across - math.cos(angle) * down)
        rotation = Rotation.from_matrix(start[:3, :3]).as_rotvec()
        return f"p[{x}, {y}, {z}, {', '.join(map(str, rotation))}]"

    quarter = 0.5 * math.pi
    controller.program.load(program(f"movec({on_circle(quarter)}, {on_circle(3 * quarter)}, a=2, v=0.1, mode={mode})"))
    angles, off = [], []
    for cycle in range(4000):
        if cycle == 1000:
            controller.program.pause()
        if cycle == 1500:
            assert controller.program.play()
        if controller.program.runtime_state is RuntimeState.STOPPED:
            break
        controller.cycles(1)
        here = model.drive.base_from_tcp()[:3, 3] - centre
        angles.append(math.atan2(across @ here, -down @ here) % (2 * math.pi))
        off.append(max(abs(np.linalg.norm(here) - 0.05), abs(np.cross(across, down) @ here)))
    assert controller.failed() == [] and model.fault_text == ""
    assert max(off) < 1e-3 and max(off[:1000]) < 1e-6, "off the circle only where it was stopped"
    assert angles[-1] == pytest.approx(3 * quarter, abs=1e-6)
    assert np.diff(np.unwrap(angles)).min() > -1e-4, "never back to the via point"
    turned = Rotation.from_matrix(start[:3, :3].T @ model.drive.base_from_tcp()[:3, :3]).magnitude()
    assert turned == pytest.approx(quarter if mode else 0.0, abs=2e-2 if mode else 1e-6)


def test_a_speed_that_nobody_repeats_and_a_killed_thread_come_to_rest(controller: Controller):
    controller.program.load(program("speedj([0.2, 0, 0, 0, 0, 0], 2.0, 0.3)", "sleep(1)"))
    controller.cycles(150)
    assert controller.model.drive.qd[0] == pytest.approx(0.2)
    controller.cycles(60)
    assert not controller.model.moving
    controller.program.load(
        "def program():\n  thread go():\n    movej([1, -1.57, -1.57, -1.57, 1.57, 0])\n  end\n"
        "  mover = run go()\n  sleep(0.3)\n  kill mover\n  sleep(1)\nend\n"
    )
    controller.cycles(140)
    assert controller.model.moving
    controller.cycles(160)
    assert not controller.model.moving


def test_two_threads_cannot_move_the_arm_at_once(controller: Controller):
    controller.run(
        "def program():\n  thread go():\n    movej([1, -1.57, -1.57, -1.57, 1.57, 0])\n  end\n"
        "  mover = run go()\n  sync()\n  sync()\n  movej([0, -1.57, -1.57, -1.57, 1.57, 0])\nend\n"
    )
    assert "another thread is already controlling the robot" in controller.failed()[0]


@pytest.mark.parametrize(("action", "state"), [("PAUSE", RuntimeState.PAUSED), ("STOP", RuntimeState.STOPPED)])
def test_a_watched_input_that_is_not_written_to_pauses_or_stops(
    controller: Controller, action: str, state: RuntimeState
):
    name = "input_int_register_0"
    controller.program.load(program(f'rtde_set_watchdog("{name}", 10, "{action}")', "while True:", "  sync()", "end"))
    for _ in range(5):
        controller.cycles(45)
        controller.registers.written[name] += 1
    assert controller.program.runtime_state is RuntimeState.PLAYING
    controller.cycles(60)
    assert controller.program.runtime_state is state
