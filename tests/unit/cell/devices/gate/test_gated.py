"""Devices of any make behind the gate: once it is shut nothing begins; looking, stopping and closing still work."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.devices import Devices
from cell.devices.gate.gated import UNATTENDED_S
from cell.devices.gate.interlocks import DeviceCommand, Rule, Situation
from cell.devices.simulated.direct import VirtualCell
from cell.motion.kinematics import HOME
from drivers.errors import Aborted, DeadlineError, InterlockError
from drivers.interfaces import Laser
from statemachine.control import CancelToken
from tests.unit.cell.devices.gate.test_interlocks import at_rest

CONFIG = load_config(None)


@pytest.fixture(scope="module")
def devices() -> Devices:
    return VirtualCell(CONFIG, seed=4, level="ideal").devices


def test_who_listens_hears_what_laser_and_camera_are_asked_for():
    devices, heard = at_rest().devices, []
    devices.gate.listener = cast(Any, SimpleNamespace(command=lambda command, refused: heard.append(str(command))))
    devices.scan_camera.configure(0.002, 50.0)
    devices.scan_camera.grab()
    with devices.scan_camera.stream() as frames:
        frames.next(1.0)
    with devices.interlocks.purpose("test"), devices.laser.lit():
        pass
    asked = [f"scan_camera.{name}" for name in ("configure", "grab", "stream", "stream ended")]
    assert heard == [*asked, "laser.lit", "laser.off"]


def test_after_the_stop_nothing_begins_and_all_can_be_read_and_stopped(devices: Devices):
    arm, rail, vehicle = devices.arm, devices.rail, devices.vehicle
    devices.gate.enter(CancelToken())
    rail.home().wait(60.0)
    joints = arm.state().joints
    assert devices.stop() == []
    for begin in (
        lambda: arm.move_joints(HOME, 0.3, 1.0),
        lambda: arm.move_linear(arm.state().flange, 0.1, 0.5),
        lambda: arm.follow(np.array([0.0, 1.0]), np.array([joints, HOME])),
        arm.recover,
        rail.home,
        lambda: rail.move_to(0.01),
        lambda: rail.nudge(0.001, 0.01),
        lambda: rail.sweep(0.02, 0.03, 0.015),
        arm.zero_force,
        lambda: arm.set_payload(1.0, np.zeros(3)),
        lambda: arm.set_digital_output(7, True),
        vehicle.enable,
        vehicle.recover,
        lambda: vehicle.drive(0.1, 0.0),
        devices.laser.lit().__enter__,
        devices.claw.grip,
        devices.claw.release,
    ):
        with pytest.raises(Aborted, match="the cell was stopped"):
            begin()
    np.testing.assert_array_equal(arm.state().joints, joints)
    assert vehicle.state().braked
    assert rail.state().homed
    assert not devices.laser.is_on
    assert [device.identity().model for device in devices]
    assert devices.stop() == devices.close() == []


def test_after_a_stop_an_output_that_is_the_lasers_can_still_be_switched_off_and_no_other():
    devices = VirtualCell(CONFIG, seed=4, level="ideal").devices
    arm, laser = devices.arm, CONFIG.laser.output
    devices.gate.enter(CancelToken())
    arm.set_digital_output(7, True)
    devices.stop()
    arm.bare.set_digital_output(laser, True)
    arm.set_digital_output(laser, False)
    with pytest.raises(Aborted):
        arm.set_digital_output(7, False)
    assert [arm.state().digital_outputs >> output & 1 for output in (7, laser)] == [1, 0]


def test_an_output_that_is_tried_goes_off_again_when_a_stop_comes_as_it_is_switched_on(monkeypatch):
    devices = VirtualCell(CONFIG, seed=4, level="ideal").devices
    arm, switch = devices.arm, devices.arm.bare.set_digital_output

    def stopped(index: int, value: bool) -> None:
        devices.gate.shut()
        switch(index, value)

    monkeypatch.setattr(arm.bare, "set_digital_output", stopped)
    with devices.interlocks.tried(7), pytest.raises(InterlockError, match="after_a_stop"):
        arm.set_digital_output(7, True)
    assert not arm.state().digital_outputs >> 7 & 1


def test_a_stop_that_comes_while_a_rule_of_the_claw_waits_leaves_the_part_held():
    """What a claw does cannot be undone without dropping the part, so it is looked again before it is told."""

    def waits(now: Situation, command: DeviceCommand) -> None:
        devices.gate.shut()

    devices = VirtualCell(CONFIG, seed=4, level="ideal").devices
    interlocks = devices.interlocks
    interlocks._rules = (*interlocks._rules, Rule("waits", ("claw.release",), "", waits))
    with interlocks.lifted(["claw_at_contact"]), pytest.raises(InterlockError, match="after_a_stop"):
        devices.claw.release()
    assert devices.claw.holding


def test_the_laser_goes_off_by_itself_when_its_owner_sleeps():
    world = at_rest()
    devices = world.devices
    with devices.interlocks.purpose("test"):
        with devices.laser.lit():
            for _ in range(4):
                world.clock.sleep(0.6 * UNATTENDED_S)
                devices.laser.renew()
            assert world.truth()["laser_on"]
        with pytest.raises(InterlockError, match=r"nobody renewed it for 20 s .*laser_attended"), devices.laser.lit():
            world.clock.sleep(UNATTENDED_S + 0.2)
            assert not world.truth()["laser_on"]
        with devices.laser.lit():
            assert world.truth()["laser_on"]


class Stubborn:
    """A laser on its switch, of which the first attempts to switch it off fail."""

    def __init__(self, bare: Laser, failures: list[Exception]) -> None:
        self.bare, self.failures = bare, failures

    def __getattr__(self, name: str) -> object:
        return getattr(self.bare, name)

    def stop(self) -> None:
        if self.failures:
            raise self.failures.pop(0)
        self.bare.stop()


def test_a_laser_that_does_not_go_off_is_switched_off_again():
    world = at_rest()
    devices = world.devices
    failures = [DeadlineError("arm", "no answer"), RuntimeError("unforeseen")]
    devices.laser.bare = Stubborn(devices.laser.bare, failures)
    with devices.interlocks.purpose("test"):
        with pytest.raises(InterlockError, match="went off because"), devices.laser.lit():
            world.clock.sleep(UNATTENDED_S + 0.2)
            assert world.truth()["laser_on"]
            world.clock.sleep(1.5)
            assert not world.truth()["laser_on"]
        devices.laser.bare.failures += [DeadlineError("arm", "no answer")] * 99
        with pytest.raises(InterlockError, match="was to go off, which is not confirmed"), devices.laser.lit():
            world.clock.sleep(UNATTENDED_S + 2.0)
    assert not world.truth()["laser_on"]
