"""The arm in this process keeps an arm's promises."""

import pytest

from drivers.errors import DeviceFault
from drivers.interfaces import ArmSafety
from tests.support.simulator.virtual_devices import CONFIG, ideal_cell


def test_a_protective_stop_is_unlocked_on_a_persons_word_after_its_delay_with_the_laser_off():
    made = ideal_cell()
    arm = made.arm
    motion = arm.move_joints(arm.state().joints + 0.5, 0.5, 1.0)
    made.clock.sleep(0.3)
    arm.set_digital_output(CONFIG.laser.output, True)
    made.fault("arm.protective_stop")
    with pytest.raises(DeviceFault, match="protective stop") as caught:
        motion.wait(30.0)
    assert (caught.value.code, caught.value.recoverable) == ("arm.protective_stop", True)
    with pytest.raises(DeviceFault, match="nobody has confirmed"):
        arm.recover()
    assert not made.world.laser.at(made.clock.now())
    begun = made.clock.now()
    arm.recover(confirmed=True)
    assert made.clock.now() - begun >= made.world.arm.params.unlock_delay
    assert arm.state().safety is ArmSafety.NORMAL
    made.fault("arm.emergency_stop")
    with pytest.raises(DeviceFault) as caught:
        arm.recover(confirmed=True)
    assert (caught.value.code, caught.value.recoverable) == ("arm.emergency_stop", False)
