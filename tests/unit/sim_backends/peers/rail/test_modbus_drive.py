"""The simulated Modbus drive without its line: registers as a map describes them."""

import numpy as np
import pytest

from drivers.rail.modbus.make import ModbusRailConfig
from sim_backends.clock import SteppedClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.modbus_drive import ModbusDriveServer
from tests.support.modbus_maps import PATHS, RAIL

TURN = 10_000


class Drive:
    """A drive of the map `PATHS`."""

    def __init__(self) -> None:
        record = ModbusRailConfig.model_validate({**RAIL, "unit": 7, "registers": PATHS})
        self.map = record.model_dump(mode="json")["registers"]
        self.clock = SteppedClock()
        self.rail = RailModel(RailParams(steps_per_turn=record.counts_per_turn), np.random.default_rng(1))
        self.server = ModbusDriveServer(self.rail, self.clock, record.model_dump(mode="json"))

    def told(self, name: str) -> int:
        entry = self.map[name]
        words = self.server.read(entry["address"], entry["words"], entry["input"])
        assert words is not None
        return int.from_bytes(b"".join(word.to_bytes(2, "big") for word in words), "big", signed=True)

    def is_set(self, name: str) -> bool:
        entry = self.map[name]
        (word,) = self.server.read(entry["address"], 1, entry["input"]) or [0]
        return bool(word >> entry["bit"] & 1) == entry["set"]

    def write(self, name: str, value: int) -> None:
        words = self.map[name]["words"]
        data = (value % (1 << 16 * words)).to_bytes(2 * words, "big")
        values = [int.from_bytes(data[k : k + 2], "big") for k in range(0, 2 * words, 2)]
        assert self.server.write(self.map[name]["address"], values)

    def act(self, name: str) -> None:
        assert self.server.write(self.map[name]["address"], [self.map[name]["value"]])


@pytest.fixture
def drive() -> Drive:
    made = Drive()
    made.act("home")
    made.clock.sleep(60.0)
    return made


def test_it_homes_and_positions_once_all_settings_are_as_they_have_to_be(drive: Drive) -> None:
    assert (drive.told("position"), drive.is_set("homed"), drive.is_set("moving")) == (0, True, False)
    for name, value in (("target", 61_500), ("speed", 450), ("acceleration", 200), ("deceleration", 200)):
        drive.write(name, value)
    for entry in drive.map["setup"]:
        assert drive.server.write(entry["address"], [entry["value"] + 1])
    drive.act("start")
    drive.clock.sleep(0.1)
    assert not drive.is_set("moving"), "a setting is wrong"
    for entry in drive.map["setup"]:
        assert drive.server.write(entry["address"], [entry["value"]])
    drive.act("start")
    drive.clock.sleep(0.1)
    assert drive.is_set("moving")
    drive.clock.sleep(60.0)
    assert (drive.told("position"), drive.is_set("moving")) == (61_500, False)


def test_what_it_has_not_does_not_exist_and_a_reset_forgets_the_zero(drive: Drive) -> None:
    assert drive.server.read(0x9999, 1, False) is None and not drive.server.write(0x9999, [1])
    assert not drive.server.write(drive.map["position"]["address"], [1, 2])
    drive.server.reset()
    assert not drive.is_set("homed")
