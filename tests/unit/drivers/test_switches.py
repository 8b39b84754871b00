"""Laser and claw on the outputs of an arm: the interlock holds, and the feedback decides."""

from collections.abc import Callable

import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import DeviceFault, InterlockError
from drivers.interfaces import ArmSafety, ArmState, Identity, LinkStatistics
from drivers.switches import ArmSwitchedClaw, ArmSwitchedLaser


class BenchArm:
    """An arm's terminal strip: outputs that can be wired to inputs; nothing moves."""

    def __init__(self) -> None:
        self.name = "arm"
        self.statistics = LinkStatistics()
        self.outputs = 0
        self.history: list[tuple[int, bool]] = []
        self.wiring: Callable[[int], int] = lambda outputs: 0

    def identity(self) -> Identity:
        return Identity("bench", "B1", "1.0", "terminals")

    def ping(self) -> float:
        return 1e-3

    def state(self, max_age: float = 0.1) -> ArmState:
        still = np.zeros(6)
        return ArmState(
            0.0, still, still, still, still, ArmSafety.NORMAL, False, self.wiring(self.outputs), self.outputs
        )

    def set_digital_output(self, index: int, value: bool) -> None:
        self.history.append((index, value))
        self.outputs = self.outputs | 1 << index if value else self.outputs & ~(1 << index)

    def digital_input(self, index: int) -> bool:
        return bool(self.wiring(self.outputs) >> index & 1)


@pytest.fixture
def arm() -> BenchArm:
    return BenchArm()


def test_the_laser_is_on_inside_its_context_only(arm: BenchArm):
    laser = ArmSwitchedLaser("laser", arm, 3)
    with laser.lit():
        assert arm.outputs == 0b1000
        assert laser.is_on
    assert arm.outputs == 0
    assert not laser.is_on


def test_an_output_that_somebody_else_has_set_is_not_taken_over(arm: BenchArm):
    arm.set_digital_output(0, True)
    laser = ArmSwitchedLaser("laser", arm, 0)
    with pytest.raises(InterlockError, match="stop"), laser.lit():
        pytest.fail("lit")
    assert laser.is_on
    laser.stop()
    with laser.lit():
        assert laser.is_on


def test_stop_and_close_switch_the_laser_off_over_its_owners_head(arm: BenchArm):
    laser = ArmSwitchedLaser("laser", arm, 0)
    with laser.lit():
        laser.stop()
        assert not laser.is_on
    with laser.lit():
        laser.close()
        assert not laser.is_on


def test_closing_on_nothing_and_a_part_that_sticks_are_faults(arm: BenchArm):
    claw = ArmSwitchedClaw("claw", arm, 1, 2, clock=Clock(100.0))
    with pytest.raises(DeviceFault, match="does not show a held part") as caught:
        claw.grip()
    assert caught.value.code == "claw.no_part"
    arm.wiring = lambda outputs: 0b100
    with pytest.raises(DeviceFault, match="still shows a held part") as caught:
        claw.release()
    assert caught.value.code == "claw.stuck"
