"""URScript on the simulated controller, without its network: the language, threads, registers, watchdogs, motions."""

from __future__ import annotations

import math
import socket

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams
from sim_backends.peers.arm.rtde.variables import Registers
from sim_backends.peers.arm.script.script import ProgramMemory, RuntimeState
from sim_backends.peers.arm.urscript.translate import ScriptCollector

TICK = 0.002


class Controller:
    """A model, its program and their common tick."""

    def __init__(self) -> None:
        self.model = ArmModel(ArmParams(), np.random.default_rng(1), WorldClock())
        self.registers = Registers()
        self.program = ProgramMemory(self.model, self.registers)

    def cycles(self, count: int) -> None:
        for _ in range(count):
            self.program.tick()
            self.model.tick(self.model.time + TICK)

    def run(self, text: str, most: int = 3000) -> None:
        """Run a program to its end."""
        self.program.load(text)
        for _ in range(most):
            if self.program.runtime_state is RuntimeState.STOPPED:
                return
            self.cycles(1)
        raise AssertionError("the program did not end")

    def said(self) -> list[str]:
        """What the program has written for the log."""
        return [one.words for one in self.program.announcements if one.kind == "text"]

    def failed(self) -> list[str]:
        return [one.words for one in self.program.announcements if one.kind == "failed"]


@pytest.fixture
def controller() -> Controller:
    return Controller()


def program(*lines: str) -> str:
    return "def program():\n" + "".join(f"  {line}\n" for line in lines) + "end\n"


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1 + 2 * 3 - 8 / 4", "5"),
        ("7 / 2", "3.5"),
        ("-2 * -(3 + 1)", "8"),
        ("17 % 5", "2"),
        ("0x1F", "31"),
        ("1e3", "1000"),
        ("not 1 > 2 and True", "True"),
        ("True xor True", "False"),
        ("False or 2 == 2.0", "True"),
        ("[1, 2, 3] + [10, 20, 30]", "[11, 22, 33]"),
        ("2 * [1, 2] - [1, 1]", "[1, 3]"),
        ("[1, 2] / 4", "[0.25, 0.5]"),
        ("[[1, 2], [3, 4]][1][0]", "3"),
        ("pow(2, 10)", "1024"),
        ("norm([3, 4])", "5"),
        ("norm(-2)", "2"),
        ("str_cat(\"a\", 1.5)", "a1.5"),
        ("str_sub(\"hello\", 1, 3)", "ell"),
        ("to_num(\"2.5\") + 1", "3.5"),
        ("get_list_length([1, 2, 3])", "3"),
        ("struct(a = 1, b = [2]).b", "[2]"),
        ("p[1, 2, 3, 0, 0, 0]", "p[1, 2, 3, 0, 0, 0]"),
        ("binary_list_to_integer(integer_to_binary_list(-5))", "-5"),
    ],
)  # fmt: skip
def test_expressions_have_the_values_of_arithmetic(controller: Controller, expression: str, value: str) -> None:
    controller.run(program(f"textmsg({expression})"))
    assert controller.said() == [value]


def test_poses_are_combined_as_an_independent_library_does_it(controller: Controller) -> None:
    a, b = [0.1, -0.2, 0.3, 0.5, -1.1, 0.7], [0.4, 0.0, -0.1, -0.2, 0.3, 2.0]
    controller.run(
        program(
            f"c = pose_trans(p{a}, p{b})",
            "i = 0",
            "while i < 6:",
            "  write_output_float_register(i, c[i])",
            "  i = i + 1",
            "end",
        )
    )
    turn = Rotation.from_rotvec(a[3:])
    np.testing.assert_allclose(controller.registers.double_out[:3], np.array(a[:3]) + turn.apply(b[:3]), atol=1e-12)
    np.testing.assert_allclose(
        Rotation.from_rotvec(controller.registers.double_out[3:6]).as_matrix(),
        (turn * Rotation.from_rotvec(b[3:])).as_matrix(),
        atol=1e-12,
    )


def test_functions_loops_branches_and_scopes(controller: Controller) -> None:
    controller.run(
        """def program():
  global total = 0
  outer = 5
  def add(value, times=1):
    local i = 0
    while True:
      if i >= times:
        break
      elif value < 0:
        return -1
      end
      total = total + value
      i = i + 1
    end
    outer = outer + 1
    hidden = 3
    return total
  end
  textmsg(add(2, times=3))
  textmsg(add(-1))
  textmsg("outer ", outer)
  numbers = [1, 2]
  others = numbers
  others[0] = 9
  textmsg(numbers)
  switch (total):
    case 5:
      textmsg("five")
    end
    case 6:
      textmsg("six")
    end
    default:
      textmsg("other")
    end
  end
  if total == 6 and
    outer == 6:
    textmsg("a line that goes on")
  end
  halt
  textmsg("never")
end
"""
    )
    assert controller.said() == ["6", "-1", "outer 6", "[1, 2]", "six", "a line that goes on"]
    assert controller.failed() == []


def test_threads_share_globals_take_turns_and_are_joined_and_killed(controller: Controller) -> None:
    controller.program.load(
        """def program():
  global count = 0
  thread counting():
    while True:
      count = count + 1
      sync()
    end
  end
  thread brief():
    sleep(0.02)
    textmsg("brief ends")
  end
  counter = run counting()
  other = run brief()
  join other
  textmsg("joined")
  sleep(0.1)
  kill counter
  seen = count
  sleep(0.1)
  textmsg(seen == count)
  textmsg(seen > 55 and seen < 65)
end
"""
    )
    controller.cycles(200)
    assert controller.said() == ["brief ends", "joined", "True", "True"]
    assert controller.program.runtime_state is RuntimeState.STOPPED


@pytest.mark.parametrize(
    ("line", "reason", "told"),
    [
        ("x = ", "'end'", (3, 1, "syntax_error_on_line:3:end:")),
        ("launch()", "'launch'", (2, 3, "compile_error_name_not_found:launch:")),
        ("if True", "needed", (2, 10, "syntax_error_on_line:2:  if True:")),
        ("@", "'@", (2, 3, "syntax_error_on_line:2:  @:")),
    ],
)
def test_a_text_that_does_not_compile_changes_nothing_and_clients_hear_what_a_controller_says(
    controller: Controller, line: str, reason: str, told: tuple[int, int, str]
) -> None:
    """The words and places are those that controllers and URSim were recorded with."""
    controller.program.load(program("while True:", "  sync()", "end"))
    controller.cycles(2)
    controller.program.load(program(line))
    assert controller.program.runtime_state is RuntimeState.PLAYING
    (failed,) = [one for one in controller.program.announcements if one.kind == "failed"]
    assert (failed.line, failed.column, failed.words) == told
    assert f"line {failed.line}" in controller.program.message and reason in controller.program.message


def test_a_run_time_error_names_the_statement_that_brought_it_about(controller: Controller) -> None:
    lines = ("def half(x):", "  y = 1", "  return y / x", "end", "a = 2", "if a == 3:", "  a = 4", "elif half(0) > 1:")
    controller.run(program(*lines, "  a = 5", "end"))
    (failed,) = [one for one in controller.program.announcements if one.kind == "failed"]
    assert (failed.line, failed.column) == (4, 5) and "division by zero" in failed.words
    controller.run(program("a = 1", "", "movej(p[10, 0, 0, 0, 0, 0])"))
    failed = [one for one in controller.program.announcements if one.kind == "failed"][-1]
    assert (failed.line, failed.column) == (4, 3) and "no solution" in failed.words


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("textmsg(missing)", "variable 'missing' is not defined"),
        ("x = 1 / 0", "division by zero"),
        ("x = [1, 2][5]", "index"),
        ("while True: \n  x = 1\n end", "infinite loop"),
        ("get_inverse_kin(p[9, 0, 0, 0, 0, 0])", "no solution"),
        ("write_output_integer_register(48, 1)", "register 48 does not exist"),
        ("movej([0, 0, 0, 0, 0])", "six"),
        ("movej([-123, 0, 0, 0, 0, 0])", "joint 0 to -123 rad"),
    ],
)
def test_a_run_time_error_ends_the_program_and_says_why(controller: Controller, line: str, reason: str) -> None:
    controller.run(program(line, 'textmsg("went on")'))
    assert controller.said() == []
    assert reason in controller.failed()[0]


def test_a_script_reaches_nothing_of_the_host(controller: Controller) -> None:
    for line in ("x = __import__", "open(1)", "exec(1)", "x = [1].__class__", "eval(1)"):
        controller.run(program(line))
    assert len(controller.failed()) == 5


def test_moves_arrive_in_the_time_they_are_given(controller: Controller) -> None:
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


def test_a_line_that_is_asked_for_in_less_time_than_the_joints_need_takes_longer(controller: Controller) -> None:
    model = controller.model
    limits = np.array(model.params.speed_limits)
    goal = model.drive.base_from_tcp()
    goal[:3, 3] += (0.0, 0.2, -0.2)
    controller.program.load(program("movel(pose_add(get_actual_tcp_pose(), p[0, 0.2, -0.2, 0, 0, 0]), t=0.05)"))
    fastest, cycles = np.zeros(6), 0
    while controller.program.runtime_state is not RuntimeState.STOPPED:
        controller.cycles(1)
        cycles += 1
        fastest = np.maximum(fastest, np.abs(model.drive.qd) / limits)
    assert model.fault_text == "" and controller.failed() == []
    assert 0.95 < fastest.max() <= 1.0, "as fast as the joints can"
    assert 30 < cycles < 500
    np.testing.assert_allclose(model.drive.base_from_tcp(), goal, atol=1e-6)


@pytest.mark.parametrize("mode", [0, 1])
def test_a_circle_goes_past_its_via_point_and_on_after_a_pause(controller: Controller, mode: int) -> None:
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


def test_points_of_a_circle_on_a_line_stop_the_arm(controller: Controller) -> None:
    line = (
        "here = get_actual_tcp_pose()",
        "movec(pose_add(here, p[0,0,-0.05,0,0,0]), pose_add(here, p[0,0,-0.1,0,0,0]))",
    )
    controller.program.load(program(*line))
    controller.cycles(20)
    assert "lie on a line" in controller.model.fault_text


def test_a_speed_that_nobody_repeats_and_a_killed_thread_come_to_rest(controller: Controller) -> None:
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


def test_two_threads_cannot_move_the_arm_at_once(controller: Controller) -> None:
    controller.run(
        "def program():\n  thread go():\n    movej([1, -1.57, -1.57, -1.57, 1.57, 0])\n  end\n"
        "  mover = run go()\n  sync()\n  sync()\n  movej([0, -1.57, -1.57, -1.57, 1.57, 0])\nend\n"
    )
    assert "another thread is already controlling the robot" in controller.failed()[0]


@pytest.mark.parametrize(("action", "state"), [("PAUSE", RuntimeState.PAUSED), ("STOP", RuntimeState.STOPPED)])
def test_a_watched_input_that_is_not_written_to_pauses_or_stops(
    controller: Controller, action: str, state: RuntimeState
) -> None:
    name = "input_int_register_0"
    controller.program.load(program(f'rtde_set_watchdog("{name}", 10, "{action}")', "while True:", "  sync()", "end"))
    for _ in range(5):
        controller.cycles(45)
        controller.registers.written[name] += 1
    assert controller.program.runtime_state is RuntimeState.PLAYING
    controller.cycles(60)
    assert controller.program.runtime_state is state


def test_a_script_talks_with_a_server_and_only_on_loopback(controller: Controller) -> None:
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    controller.program.load(
        program(
            'textmsg(socket_open("192.0.2.1", 5))',
            f'textmsg(socket_open("127.0.0.1", {port}, "s"))',
            'textmsg(socket_read_binary_integer(2, "s", 0.01))',
            'socket_send_line("hello", "s")',
            'socket_send_int(-2, "s")',
            'textmsg(socket_read_binary_integer(2, "s", 0))',
            'textmsg(socket_read_ascii_float(2, "s"))',
            'textmsg(socket_read_string("s", "<", ">"))',
        )
    )
    controller.cycles(20)
    connection = server.accept()[0]
    assert connection.recv(100) == b"hello\n\xff\xff\xff\xfe"
    assert controller.program.runtime_state is RuntimeState.PLAYING
    connection.sendall(b"\0\0\0\7\xff\xff\xff\xff(1.5, 2)<ok>")
    controller.cycles(10)
    connection.close()
    server.close()
    assert controller.said() == ["False", "True", "[0, 0, 0]", "[2, 7, -1]", "[2, 1.5, 2]", "ok"]


def test_texts_are_taken_whole_however_they_arrive() -> None:
    text = "def a():\n  def b():\n  if True:\n sync()\nend\nend\nb()\nend\n"
    collector = ScriptCollector()
    whole = [one for byte in (text + "movej([0])\n").encode() for one in collector.feed(bytes([byte]))]
    assert whole == [text, "movej([0])\n"]
    assert ScriptCollector(longest=100).feed(b"def a():\n" + b"x" * 200) == []


def test_actual_values_are_those_of_the_arm(controller: Controller) -> None:
    controller.run(
        program(
            "set_tcp(p[0, 0, 0.1, 0, 0, 0])",
            "q = get_actual_joint_positions()",
            "again = get_inverse_kin(get_forward_kin(q), q)",
            "write_output_float_register(0, norm(again - q))",
            "write_output_float_register(1, point_dist(get_actual_tcp_pose(), get_actual_tool_flange_pose()))",
            "write_output_float_register(2, get_steptime())",
        )
    )
    error, length, step = controller.registers.double_out[:3]
    assert error < 1e-8
    assert math.isclose(length, 0.1, abs_tol=1e-12)
    assert step == TICK


NESTED = "def program():\n" + "while True:\n" * 25 + "end\n" * 26
SAME_NAME_TWICE = "def program():\n  def f(a, a):\n  end\nend\n"


@pytest.mark.parametrize(
    "text",
    [
        NESTED,
        SAME_NAME_TWICE,
        program("x = " + "(" * 3000 + "1" + ")" * 3000),
        program("x = " + "+".join(["1"] * 20000)),
        program("break"),
        program("3 = 3"),
    ],
)
def test_a_text_that_python_does_not_compile_is_a_compile_error(controller: Controller, text: str) -> None:
    assert not controller.program.load(text)
    assert controller.failed()


FIBONACCI = "def program():\n def f(n):\n  if n < 2:\n   return n\n  end\n  return f(n-1)+f(n-2)\n end\n f(60)\nend\n"
FORKING = "def program():\n thread t():\n  run t()\n  run t()\n  sync()\n end\n run t()\n sleep(1)\nend\n"
SQUARES = "def program():\n def f(n):\n  return f(n*n)\n end\n f(9)\nend\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (FIBONACCI, "infinite loop"),
        (FORKING, "threads"),
        (SQUARES, "bits"),
        (program("x = 9", "while True:", "x = x * x", "end"), "bits"),
        (program('x = "aaaaaaaa"', "while True:", "x = str_cat(x, x)", "end"), "characters"),
        (program("x = [1, 1]", "while True:", "x = [x, x]", "end"), "values"),
        (program("x = make_list(2000000000, 0)"), "elements"),
        (program("x = pow(10, 1000000000)"), "range"),
        (program("socket_send_int(99999999999)"), "2147483647"),
    ],
)
def test_a_script_that_would_never_give_way_ends_and_the_controller_goes_on(
    controller: Controller, text: str, reason: str
) -> None:
    controller.run(text, 60)
    assert reason in controller.failed()[-1]
    controller.run(program("sync()"))


def test_a_function_changes_only_its_own_copy_of_a_list(controller: Controller) -> None:
    controller.run(
        "def program():\n  def f(a):\n    a[0] = 7\n  end\n  b = [1]\n  f(b)\n  textmsg(to_str(b[0]))\nend\n"
    )
    assert controller.said() == ["1"]
