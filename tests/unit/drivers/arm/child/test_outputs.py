"""Promises of `drivers.arm.child.outputs`."""

import pytest

from tests.support.wire.arm_bench import soon

pytestmark = pytest.mark.wire


@pytest.mark.parametrize("index", [1, 9, 17])
def test_digital_outputs_are_on_when_the_call_returns(arm, bench, index):
    arm.set_digital_output(index, True)
    assert arm.state().digital_outputs >> index & 1
    assert bench.ask("show")["outputs"] >> index & 1
    arm.set_digital_output(index, False)
    assert not bench.ask("show")["outputs"] >> index & 1


def test_digital_inputs_are_read(arm, bench):
    bench.ask("input 3 1")
    assert soon(lambda: arm.digital_input(3))
    bench.ask("input 3 0")
    assert soon(lambda: not arm.digital_input(3))
