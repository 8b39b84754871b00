"""Makes beside the stock cell's: their records as docs/how-to/other-makes.md prints them, what is refused, no wires."""

from typing import Any

import pytest

from cell.devices.assembly import safe_off_outputs
from cell.devices.contracts import ClawContract, LaserContract, RailContract
from cell.devices.simulated.described import Described
from cell.makes import BUILT_IN
from sim_backends.peers.switches import switch_peers
from sim_backends.serve import rail_peer
from sim_backends.world.drawing import read
from sim_backends.world.world import World
from tests.support.wire.other_makes import LCUS, MODBUS, NUMATO, ROBOTIQ, cell, refusal_of
from tests.unit.cell.devices.contracts.test_device import Direct


@pytest.mark.parametrize("tables", [(MODBUS,), (NUMATO,), (LCUS, ROBOTIQ), (MODBUS, NUMATO, ROBOTIQ)])
def test_what_the_document_prints_is_a_cell_that_is_simulated_as_it_is_described(tables: tuple[dict[str, Any]]):
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


def test_no_output_of_the_arm_belongs_to_a_laser_on_a_board():
    assert safe_off_outputs(cell(LCUS)) == ()
    assert [make.name for make in BUILT_IN if make.kind == "claw"] == ["arm_output", "numato", "robotiq"]


@pytest.mark.parametrize(
    ("tables", "told"),
    [
        (({"claw": {**ROBOTIQ["claw"], "force": 300}},), "0 open, slowest, weakest; 255 the other end"),
        (({"claw": {**ROBOTIQ["claw"], "address": "192.0.2.10"}},), "has no port; write HOST:PORT"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_with_key_value_and_what_is_allowed(tables: tuple[dict[str, Any], ...], told: str):
    assert told in refusal_of(*tables)


class _Virtual(Direct):
    CONFIG = cell(MODBUS, LCUS, ROBOTIQ)


class TestVirtualRail(_Virtual, RailContract):
    NAME = "rail"


class TestVirtualLaser(_Virtual, LaserContract):
    NAME = "laser"


class TestVirtualClaw(_Virtual, ClawContract):
    NAME = "claw"
