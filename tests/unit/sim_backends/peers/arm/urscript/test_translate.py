"""URScript as it is translated: control flow, what does not compile, texts that arrive in parts."""

import pytest

from sim_backends.peers.arm.program import RuntimeState
from sim_backends.peers.arm.urscript.translate import ScriptCollector
from tests.support.simulator.script_controller import Controller, program


def test_functions_loops_branches_and_scopes(controller: Controller):
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
end"""
    )
    assert controller.said() == ["6", "-1", "outer 6", "[1, 2]", "six", "a line that goes on"]
    assert controller.failed() == []


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
):
    """The words and places are those that controllers and URSim were recorded with."""
    controller.program.load(program("while True:", "  sync()", "end"))
    controller.cycles(2)
    controller.program.load(program(line))
    assert controller.program.runtime_state is RuntimeState.PLAYING
    (failed,) = [one for one in controller.program.announcements if one.kind == "failed"]
    assert (failed.line, failed.column, failed.words) == told
    assert f"line {failed.line}" in controller.program.message and reason in controller.program.message


def test_texts_are_taken_whole_however_they_arrive():
    text = "def a():\n  def b():\n  if True:\n sync()\nend\nend\nb()\nend\n"
    collector = ScriptCollector()
    whole = [one for byte in (text + "movej([0])\n").encode() for one in collector.feed(bytes([byte]))]
    assert whole == [text, "movej([0])\n"]
    assert ScriptCollector(longest=100).feed(b"def a():\n" + b"x" * 200) == []


NESTED = "def program():\n" + "while True:\n" * 25 + "end\n" * 26
SAME_NAME_TWICE = "def program():\n  def f(a, a):\n  end\nend\n"


@pytest.mark.parametrize(
    "text",
    [
        NESTED,
        SAME_NAME_TWICE,
        program("x = " + "(" * 3000 + "1" + ")" * 3000),
        program("x = " + "+".join(["1"] * 5000)),
        program("break"),
        program("3 = 3"),
    ],
)
def test_a_text_that_python_does_not_compile_is_a_compile_error(controller: Controller, text: str):
    assert not controller.program.load(text) and controller.failed()
