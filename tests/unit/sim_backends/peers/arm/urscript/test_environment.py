"""What a URScript program computes with: numbers, lists, texts, poses."""

import pytest

from tests.support.simulator.script_controller import Controller, program


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
def test_expressions_have_the_values_of_arithmetic(controller: Controller, expression: str, value: str):
    controller.run(program(f"textmsg({expression})"))
    assert controller.said() == [value]
