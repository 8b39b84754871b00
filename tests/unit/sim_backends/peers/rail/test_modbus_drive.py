"""The simulated Modbus drive without its line: registers as a map describes them. The rail's own tests drive it."""

import numpy as np

from drivers.rail.modbus.make import ModbusRailConfig
from sim_backends.clock import SteppedClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.modbus_drive import ModbusDriveServer
from tests.support.modbus_maps import PATHS, RAIL


def test_it_positions_once_all_settings_are_as_they_have_to_be_and_a_reset_forgets_the_zero():
    record = ModbusRailConfig.model_validate({**RAIL, "unit": 7, "registers": PATHS})
    clock, rail = SteppedClock(), RailModel(RailParams(steps_per_turn=10_000), np.random.default_rng(1))
    drive = ModbusDriveServer(rail, clock, record.model_dump(mode="json"))

    def shows(bit: int) -> bool:
        (word,) = drive.read(0x1003, 1, False) or [0]
        return bool(word >> bit & 1)

    def start() -> None:
        assert drive.write(PATHS["start"]["address"], [PATHS["start"]["value"]])
        clock.sleep(0.1)

    moving, homed = PATHS["moving"]["bit"], PATHS["homed"]["bit"]
    assert drive.write(PATHS["home"]["address"], [PATHS["home"]["value"]])
    clock.sleep(60.0)
    assert shows(homed) and not shows(moving)
    for name, words in (("target", [0, 61_500]), ("speed", [450]), ("acceleration", [200]), ("deceleration", [200])):
        assert drive.write(PATHS[name]["address"], words)
    assert drive.write(0x6200, [2])
    start()
    assert not shows(moving), "a setting is wrong"
    assert drive.write(0x6200, [1])
    start()
    assert shows(moving)
    clock.sleep(60.0)
    assert (drive.read(PATHS["position"]["address"], 2, False), shows(moving)) == ([0, 61_500], False)
    drive.reset()
    assert not shows(homed)
