"""A URScript program as it runs: its threads, its errors, and what ends one that would never give way."""

import pytest

from sim_backends.peers.arm.program import RuntimeState
from tests.support.simulator.script_controller import Controller, program


def test_threads_share_globals_take_turns_and_are_joined_and_killed(controller: Controller):
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
end"""
    )
    controller.cycles(200)
    assert controller.said() == ["brief ends", "joined", "True", "True"]
    assert controller.program.runtime_state is RuntimeState.STOPPED


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
def test_a_run_time_error_ends_the_program_and_says_why(controller: Controller, line: str, reason: str):
    controller.run(program(line, 'textmsg("went on")'))
    assert controller.said() == []
    assert reason in controller.failed()[0]


def test_a_script_reaches_nothing_of_the_host(controller: Controller):
    for line in ("x = __import__", "open(1)", "exec(1)", "x = [1].__class__", "eval(1)"):
        controller.run(program(line))
    assert len(controller.failed()) == 5


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
):
    controller.run(text, 60)
    assert reason in controller.failed()[-1]
    controller.run(program("sync()"))
