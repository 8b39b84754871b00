"""The safe stop brings everything to rest at once, by the world's truth, and shuts the gate for whoever works."""

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.assembly import connect
from drivers.errors import Aborted
from statemachine.control import CancelToken
from tests.support.wire.cells import ask, assert_safe, served

pytestmark = pytest.mark.wire


def test_everything_moves_and_shines_and_nothing_does_after_the_stop(tmp_path):
    with served(tmp_path, "--seed", "3", "--speed", "1") as endpoints:
        config = load_config(tmp_path / "sim.toml")
        devices = connect(config)
        try:
            devices.gate.enter(CancelToken())
            arm, vehicle = (
                devices.arm.bare,
                devices.vehicle.bare,
            )  # the interlocks would not let all of it begin at once
            devices.rail.home().wait(60.0)
            devices.rail.move_to(0.09, 0.01)
            arm.set_digital_output(config.laser.output, True)
            away = arm.state().joints + np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0])
            arm.move_joints(away, 0.3, 1.0)
            vehicle.enable()
            vehicle.drive(-0.2, 0.0)
            devices.clock.sleep(0.4)
            truth = ask(endpoints, op="truth")["truth"]
            assert truth["laser_on"] and truth["arm"]["moving"] and truth["rail_moving"]
            assert not truth["vehicle"]["stopped"]

            assert devices.stop() == []
            assert_safe(endpoints)
            for begin in (
                lambda: devices.arm.move_joints(away, 0.3, 1.0),
                lambda: devices.rail.move_to(0.01),
                devices.vehicle.enable,
                lambda: devices.vehicle.drive(-0.2, 0.0),
                lambda: devices.laser.lit().__enter__(),
                devices.claw.release,
            ):
                with pytest.raises(Aborted):
                    begin()
            assert_safe(endpoints)

            devices.gate.enter(CancelToken())
            devices.rail.move_to(0.01).wait(60.0)
        finally:
            assert devices.close() == []
