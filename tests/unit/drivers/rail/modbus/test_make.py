"""Promises of `drivers.rail.modbus.make`."""

import json
from typing import Any

import pytest

from cell.config.cell_config import load_config
from drivers.rail.modbus.make import AccelerationConfig, NumberConfig
from tests.support.modbus_maps import EDGES, PATHS, RAIL
from tests.support.wire.modbus_bench import config
from tests.support.wire.other_makes import LCUS, MODBUS, ROBOTIQ, cell, refusal_of


def test_a_rail_of_another_make_is_another_configuration_for_a_calibration_and_another_switch_is_none():
    """What positions mean hangs on the rail's map, where the light plane lies does not hang on the laser's switch."""
    stock = load_config(None).calibration_hash()
    with_drive = cell(MODBUS).calibration_hash()
    assert stock != with_drive
    turned = {"rail": {**MODBUS["rail"], "counts_per_turn": 4000}}
    homed_elsewhere = json.loads(json.dumps(MODBUS))
    homed_elsewhere["rail"]["registers"]["home"]["value"] = 0x21
    assert len({with_drive, cell(turned).calibration_hash(), cell(homed_elsewhere).calibration_hash()}) == 3
    witness = {"witness": "0 mm"}
    assert cell({"laser": {**LCUS["laser"], **witness}}, ROBOTIQ).calibration_hash() == stock


def registers(**changed: Any) -> dict[str, Any]:
    return {"rail": {**RAIL, "registers": {**PATHS, **changed}}}


@pytest.mark.parametrize("value", [0, 1, -1, 65_536, -70_000, 2**31 - 1, -(2**31)])
def test_a_number_of_two_registers_comes_back(value: int):
    number = NumberConfig(address=0)
    assert number.decode(number.encode(value)) == value
    with pytest.raises(ValueError, match="16 bits"):
        NumberConfig(address=0, words=1).encode(70_000)
    with pytest.raises(ValueError, match="16 bits with a sign"):
        NumberConfig(address=0, words=1).encode(32_800, signed=True)


@pytest.mark.parametrize("unit", ["rpm/s", "1/6 rps/s", "counts/s^2", "ms to 1000 rpm"])
def test_a_ramp_in_the_drives_unit_is_never_longer_than_reckoned(unit: str):
    """v²/2a has to hold: the acceleration is rounded up, the time that stands for it down."""
    rate = AccelerationConfig(address=0, unit=unit)  # type: ignore[arg-type]
    for turns in (0.7, 3.3, 41.7, 100.0, 777.7):
        assert rate.turns(rate.units(turns, 4096), 4096) >= turns * (1 - 1e-12)


def test_actions_and_flags_of_a_map_mean_what_its_manual_says():
    made = config(EDGES).registers
    assert made.start.writes == [8, 0]
    assert made.moving.decode(0) and not made.moving.decode(1 << 5)


@pytest.mark.parametrize(
    ("tables", "told"),
    [
        ((registers(alarm={"address": 0x6203, "words": 1}),), "speed and alarm both use register 0x6203"),
        ((registers(target={"address": 0x6201, "input": True}),), "input registers cannot be written"),
        ((registers(moving={"address": 0x1003, "bit": 16}),), "16 is outside the allowed range (allowed: 0 to 15)"),
        ((registers(home={"address": 70000, "value": 1}),), "70000 is outside the allowed range (allowed: 0 to 65535)"),
        ((registers(speed={"address": 0x6203, "unit": "mm/s"}),), '"mm/s" is not one of "counts/s"'),
        ((registers(position={"address": 0x602C, "words": 1}),), "the drive's registers count to 32767"),
        (({"rail": {key: value for key, value in RAIL.items() if key != "registers"}},), "rail.registers: missing"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_with_key_value_and_what_is_allowed(tables: tuple[dict[str, Any], ...], told: str):
    assert told in refusal_of(*tables)
