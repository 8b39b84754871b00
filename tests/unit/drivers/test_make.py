"""Makes beside the stock cell's: their records as docs/how-to/other-makes.md prints them, what is refused, no wires."""

from __future__ import annotations

import json
import re
import tomllib
from typing import Any

import pytest

from cell.config.cell_config import CellConfig, load_config, tables_of, validate
from cell.devices.assembly import safe_off_outputs
from cell.devices.contracts import Bench, ClawContract, LaserContract, RailContract
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.makes import BUILT_IN
from drivers.errors import ConfigError
from drivers.rail.modbus.link import Number
from drivers.rail.modbus.make import register_map
from sim_backends.peers.switches import switch_peers
from sim_backends.serve import rail_peer
from sim_backends.world.drawing import read
from sim_backends.world.world import World
from tests.support import ROOT
from tests.support.modbus_maps import EDGES, PATHS, RAIL
from tests.unit.cell.devices.contracts.test_device import DirectFaults

PRINTED = [
    tomllib.loads(block)
    for block in re.findall(
        r"```toml\n(.*?)```", (ROOT / "docs" / "how-to" / "other-makes.md").read_text(encoding="utf-8"), re.DOTALL
    )
]
MODBUS, NUMATO, LCUS, ROBOTIQ = PRINTED


def cell(*tables: dict[str, Any], **changed: Any) -> CellConfig:
    """The stock cell with these tables instead of its own, and `device__key` values changed."""
    made = tables_of(None)
    for table in tables:
        made |= table
    for key, value in changed.items():
        device, _, name = key.partition("__")
        made[device] = {**made[device], name: value}
    return validate(CellConfig, made, "cell.toml")


@pytest.mark.parametrize("tables", [(MODBUS,), (NUMATO,), (LCUS, ROBOTIQ), (MODBUS, NUMATO, ROBOTIQ)])
def test_what_the_document_prints_is_a_cell_that_is_simulated_as_it_is_described(tables: tuple[dict[str, Any]]) -> None:
    """The drawing goes through its text, as it does to the serving process, and every device has its peer."""
    config = cell(*tables)
    drawing = Described.of("pot").drawing(config)
    assert read(drawing.as_json()).cell.wires == drawing.cell.wires
    world = World(1, "ideal", 1.0, drawing)
    peers, endpoints = switch_peers(world)
    for name in endpoints:
        assert config.make(name).simulated is not None
    assert set(endpoints) == {name for name in ("laser", "claw") if not config.make(name).on_arm}
    for peer in (*peers, rail_peer(world)):
        peer.stop()


def test_a_rail_of_another_make_is_another_configuration_for_a_calibration_and_another_switch_is_none() -> None:
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


def test_no_output_of_the_arm_belongs_to_a_laser_on_a_board() -> None:
    assert safe_off_outputs(cell(LCUS)) == ()
    assert [make.name for make in BUILT_IN if make.kind == "claw"] == ["arm_output", "numato", "robotiq"]


def registers(**changed: Any) -> dict[str, Any]:
    return {"rail": {**RAIL, "registers": {**PATHS, **changed}}}


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
        ((NUMATO, {"claw": {**NUMATO["claw"], "baud": 115200}}), "laser and claw are both at /dev/ttyACM1"),
        ((NUMATO, {"claw": {**NUMATO["claw"], "relay": 0}}), "laser.url and claw.url are both"),
        ((NUMATO, {"rail": {**tables_of(None)["rail"], "url": "/dev/ttyACM1"}}), "each has a port of its own"),
        (({"laser": {**LCUS["laser"], "relay": 0}},), "relays as the board counts them, from 1"),
        (({"claw": {**ROBOTIQ["claw"], "force": 300}},), "0 open, slowest, weakest; 255 the other end"),
        (({"claw": {**ROBOTIQ["claw"], "address": "192.0.2.10"}},), "has no port; write HOST:PORT"),
        (({"claw": {**LCUS["laser"]}},), '"lcus" is not one of'),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_with_key_value_and_what_is_allowed(
    tables: tuple[dict[str, Any], ...], told: str
) -> None:
    with pytest.raises(ConfigError) as met:
        cell(*tables)
    assert told in str(met.value)


def test_the_map_of_a_drive_reaches_the_driver_as_it_is_written() -> None:
    made = register_map(cell({"rail": {**RAIL, "registers": EDGES}}).rail.registers)  # type: ignore[attr-defined]
    assert made.position == Number(0x00CC, 2, True, False)
    assert made.start.writes == [8, 0]
    assert made.moving.decode(0) and not made.moving.decode(1 << 5)


class _Virtual:
    NAME = ""

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Bench[Any]:
        virtual = VirtualCell(cell(MODBUS, LCUS, ROBOTIQ), seed=4, level="ideal")
        device = getattr(virtual.devices, cls.NAME).bare
        return Bench(lambda: device, virtual.clock, linked=False, faults=DirectFaults(virtual))


class TestVirtualRail(_Virtual, RailContract):
    NAME = "rail"


class TestVirtualLaser(_Virtual, LaserContract):
    NAME = "laser"


class TestVirtualClaw(_Virtual, ClawContract):
    NAME = "claw"
