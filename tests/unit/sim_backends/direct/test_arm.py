"""The arm in this process keeps an arm's promises."""

import pytest

from cell.config.cell_config import load_config
from drivers.errors import DeviceFault
from drivers.interfaces import ArmSafety


def test_a_protective_stop_is_unlocked_on_a_persons_word_after_its_delay_with_the_laser_off(fresh):
    arm = fresh.arm
    motion = arm.move_joints(arm.state().joints + 0.5, 0.5, 1.0)
    fresh.clock.sleep(0.3)
    arm.set_digital_output(load_config(None).laser.output, True)
    fresh.fault("arm.protective_stop")
    with pytest.raises(DeviceFault, match="protective stop") as caught:
        motion.wait(30.0)
    assert (caught.value.code, caught.value.recoverable) == ("arm.protective_stop", True)
    with pytest.raises(DeviceFault, match="nobody has confirmed"):
        arm.recover()
    assert not fresh.world.laser.at(fresh.clock.now())
    begun = fresh.clock.now()
    arm.recover(confirmed=True)
    assert fresh.clock.now() - begun >= fresh.world.arm.params.unlock_delay
    assert arm.state().safety is ArmSafety.NORMAL
    fresh.fault("arm.emergency_stop")
    with pytest.raises(DeviceFault) as caught:
        arm.recover(confirmed=True)
    assert (caught.value.code, caught.value.recoverable) == ("arm.emergency_stop", False)
