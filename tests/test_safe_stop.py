"""The safe stop brings every device to rest, whatever it does, and bars whoever works; by the world's truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cell.config import load_config
from cell.devices.direct import VirtualCell
from cell.devices.stopping import stop_cell
from cell.steps.moves import HOME
from drivers.errors import Aborted
from statemachine.cancel import CancelToken

CONFIG = load_config(None)


@pytest.fixture
def cell() -> VirtualCell:
    return VirtualCell(CONFIG, 1)


def stays(cell: VirtualCell, value: Callable[[], object]) -> bool:
    """Whether `value` is the same after two seconds of the world."""
    before = np.array(value(), dtype=float)
    cell.clock.sleep(2.0)
    return bool(np.allclose(before, np.array(value(), dtype=float), atol=1e-9))


def test_the_laser_goes_off(cell: VirtualCell) -> None:
    # A switch without an owner: what goes off is what the stop switches off.
    cell.arm.set_digital_output(CONFIG.laser.output, True)
    assert cell.devices.laser.is_on
    stop_cell(cell.devices)
    assert not cell.world.arm.digital_outputs >> CONFIG.laser.output & 1


def test_the_vehicle_stands_and_its_brake_is_locked(cell: VirtualCell) -> None:
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


def test_the_rail_stands(cell: VirtualCell) -> None:
    cell.devices.rail.home().wait(60.0)
    cell.devices.rail.move_to(0.09, 0.01)
    cell.clock.sleep(0.4)
    assert cell.devices.rail.state().velocity > 0.0
    stop_cell(cell.devices)
    cell.clock.sleep(0.2)  # its ramp
    assert stays(cell, lambda: cell.devices.rail.state().position)


def test_the_arm_stands(cell: VirtualCell) -> None:
    cell.devices.vehicle.brake()
    away = cell.devices.arm.state().joints + np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0])
    cell.devices.arm.move_joints(away, 0.3, 1.0)
    cell.clock.sleep(0.4)
    assert cell.devices.arm.state().moving
    stop_cell(cell.devices)
    assert stays(cell, lambda: cell.devices.arm.state().joints)


def test_whoever_works_begins_nothing_any_more(cell: VirtualCell) -> None:
    cell.devices.gate.enter(CancelToken())
    cell.devices.gate.require()
    stop_cell(cell.devices)
    with pytest.raises(Aborted, match="the cell was stopped"):
        cell.devices.gate.require()
