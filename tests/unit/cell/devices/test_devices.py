"""The safe stop brings every device to rest, whatever it does, and bars whoever works; by the world's truth."""

from collections.abc import Callable

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.devices import require_healthy, require_no_emergency_stop, stop_cell
from cell.devices.simulated.direct import VirtualCell
from cell.motion.kinematics import HOME
from drivers.errors import Aborted, DeviceFault
from statemachine.control import CancelToken
from tests.unit.drivers.vehicle.test_fixed import fixed_cell

CONFIG = load_config(None)


@pytest.fixture
def cell() -> VirtualCell:
    return VirtualCell(CONFIG, 1)


def stays(cell: VirtualCell, value: Callable[[], object]) -> bool:
    """Whether `value` is the same after two seconds of the world."""
    before = np.array(value(), dtype=float)
    cell.clock.sleep(2.0)
    return bool(np.allclose(before, np.array(value(), dtype=float), atol=1e-9))


def test_the_laser_goes_off(cell: VirtualCell):
    # A switch without an owner: what goes off is what the stop switches off.
    cell.arm.set_digital_output(CONFIG.laser.output, True)
    assert cell.devices.laser.is_on
    stop_cell(cell.devices)
    assert not cell.world.arm.digital_outputs >> CONFIG.laser.output & 1


def test_the_vehicle_stands_and_its_brake_is_locked(cell: VirtualCell):
    cell.devices.vehicle.brake()
    cell.devices.arm.move_joints(HOME, 0.5, 1.0).wait(60.0)
    cell.devices.vehicle.enable()
    cell.devices.vehicle.drive(-0.2, 0.1)
    cell.clock.sleep(0.4)
    model = cell.world.vehicle
    assert model.feedback(cell.clock.now()).speed < -0.1
    stop_cell(cell.devices)
    assert model.feedback(cell.clock.now()).braked
    assert stays(cell, lambda: model.planar(cell.clock.now()))


def test_the_rail_stands(cell: VirtualCell):
    cell.devices.rail.home().wait(60.0)
    cell.devices.rail.move_to(0.09, 0.01)
    cell.clock.sleep(0.4)
    assert cell.devices.rail.state().velocity > 0.0
    stop_cell(cell.devices)
    cell.clock.sleep(0.2)  # its ramp
    assert stays(cell, lambda: cell.devices.rail.state().position)


def test_the_arm_stands(cell: VirtualCell):
    cell.devices.vehicle.brake()
    away = cell.devices.arm.state().joints + np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0])
    cell.devices.arm.move_joints(away, 0.3, 1.0)
    cell.clock.sleep(0.4)
    assert cell.devices.arm.state().moving
    stop_cell(cell.devices)
    assert stays(cell, lambda: cell.devices.arm.state().joints)


def test_whoever_works_begins_nothing_any_more(cell: VirtualCell):
    cell.devices.gate.enter(CancelToken())
    cell.devices.gate.require()
    stop_cell(cell.devices)
    with pytest.raises(Aborted, match="the cell was stopped"):
        cell.devices.gate.require()


def test_a_device_that_does_not_confirm_is_named_and_the_others_are_stopped(tmp_path):
    """A stop that was not confirmed is a fault, whatever else answers: here of a vehicle whose driver is closed."""
    cell = VirtualCell(load_config(fixed_cell(tmp_path)), 1)
    cell.arm.set_digital_output(CONFIG.laser.output, True)
    away = cell.arm.state().joints + np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0])
    cell.arm.move_joints(away, 0.3, 1.0)
    cell.devices.vehicle.close()
    with pytest.raises(DeviceFault, match="vehicle stopped and braked: not confirmed") as caught:
        stop_cell(cell.devices)
    assert (caught.value.code, caught.value.recoverable) == ("safe_stop", False)
    assert not cell.world.arm.digital_outputs >> CONFIG.laser.output & 1
    assert stays(cell, lambda: cell.arm.state().joints)


@pytest.mark.parametrize("name", ["laser", "vehicle", "rail", "arm"])
def test_a_cell_that_was_opened_without_a_device_stops_the_others(cell: VirtualCell, name: str):
    setattr(cell.devices, f"_{name}", None)
    assert name not in cell.devices
    require_healthy(cell.devices)
    require_no_emergency_stop(cell.devices)
    assert cell.devices.stop() == []


def test_who_closes_the_cell_closes_each_device_and_the_arm_last(cell: VirtualCell):
    """Laser and claw hang on the arm's outputs."""
    names = [device.name for device in cell.devices]
    assert names[-1] == "arm"
    assert len(names) == len(set(names)) == 7


class Stuck:
    """A device whose end fails."""

    def __init__(self, bare: object) -> None:
        self.bare = bare

    def __getattr__(self, name: str) -> object:
        return getattr(self.bare, name)

    def close(self) -> None:
        raise RuntimeError("its port is stuck")


def test_a_device_that_cannot_be_closed_keeps_no_other_open(cell: VirtualCell):
    """The laser's driver is the first to be closed; the arm, closed last, takes its output off nevertheless."""
    cell.devices.laser.bare = Stuck(cell.devices.laser.bare)  # type: ignore[assignment]
    cell.arm.set_digital_output(CONFIG.laser.output, True)
    cell.devices.vehicle.brake()
    cell.devices.arm.move_joints(HOME, 0.5, 1.0)
    cell.clock.sleep(0.2)
    assert cell.devices.close() == ["laser closed: its port is stuck"]
    assert not cell.world.arm.digital_outputs >> CONFIG.laser.output & 1
    assert stays(cell, lambda: cell.arm.state().joints)


@pytest.mark.parametrize(
    ("name", "recoverable"),
    [
        ("arm.protective_stop", True),
        ("arm.safeguard_stop", False),
        ("arm.emergency_stop", False),
        ("vehicle.emergency_stop", False),
        ("vehicle.motor_fault", True),
    ],
)
def test_what_ails_arm_or_vehicle_ends_a_run_and_in_a_jog_an_emergency_stop_alone(
    cell: VirtualCell, name: str, recoverable: bool
):
    require_healthy(cell.devices)
    cell.fault(name)
    with pytest.raises(DeviceFault) as caught:
        require_healthy(cell.devices)
    assert caught.value.recoverable is recoverable
    assert caught.value.code == ("vehicle.error" if name == "vehicle.motor_fault" else name)
    if not name.endswith("emergency_stop"):
        require_no_emergency_stop(cell.devices)
        return
    with pytest.raises(DeviceFault, match="emergency stop"):
        require_no_emergency_stop(cell.devices)


def test_of_two_faults_the_emergency_stop_is_told(cell: VirtualCell):
    cell.fault("arm.protective_stop")
    cell.fault("vehicle.emergency_stop")
    with pytest.raises(DeviceFault) as caught:
        require_healthy(cell.devices)
    assert caught.value.code == "vehicle.emergency_stop"
