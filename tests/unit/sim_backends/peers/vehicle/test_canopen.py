"""The simulated wheel drives under a master that others wrote: `BaseNode402` of the `canopen` package."""

import math
from collections.abc import Iterator

import canopen
import pytest
from canopen.objectdictionary import INTEGER8, INTEGER32, UNSIGNED8, UNSIGNED16, UNSIGNED32, ObjectDictionary, ODRecord
from canopen.objectdictionary import ODVariable as Variable
from canopen.profiles.p402 import BaseNode402

from tests.support.canopen_bench import Bench

pytestmark = pytest.mark.wire


def variable(index: int, kind: int, name: str, sub: int = 0) -> Variable:
    made = Variable(name, index, sub)
    made.data_type = kind
    return made


def dictionary() -> ObjectDictionary:
    found = ObjectDictionary()
    for index, kind, name in (
        (0x1000, UNSIGNED32, "type"), (0x6040, UNSIGNED16, "controlword"), (0x6041, UNSIGNED16, "statusword"),
        (0x6060, INTEGER8, "mode"), (0x6061, INTEGER8, "mode shown"), (0x6064, INTEGER32, "position"),
        (0x606C, INTEGER32, "velocity"), (0x60FF, INTEGER32, "target velocity"), (0x6502, UNSIGNED32, "modes"),
    ):  # fmt: skip
        found.add_object(variable(index, kind, name))
    for k in range(4):
        for parameter in (0x1400 + k, 0x1800 + k):
            record = ODRecord(f"parameter {parameter:X}", parameter)
            for sub, kind in ((0, UNSIGNED8), (1, UNSIGNED32), (2, UNSIGNED8)):
                record.add_member(variable(parameter, kind, f"sub {sub}", sub))
            found.add_object(record)
            mapping = ODRecord(f"mapping {parameter + 0x200:X}", parameter + 0x200)
            for sub in range(9):
                kind = UNSIGNED32 if sub else UNSIGNED8
                mapping.add_member(variable(parameter + 0x200, kind, f"sub {sub}", sub))
            found.add_object(mapping)
    return found


@pytest.fixture
def bench() -> Iterator[tuple[Bench, canopen.Network, list[BaseNode402]]]:
    made, network, known = Bench(), canopen.Network(), dictionary()
    network.connect(channel=made.channel, interface="virtual")
    nodes = [network.add_node(BaseNode402(number, known)) for number in (1, 2)]
    yield made, network, nodes
    network.sync.stop()
    network.disconnect()
    made.peer.stop()


def test_another_master_maps_pdos_and_takes_the_drives_through_their_states(bench):
    made, network, nodes = bench
    for node in nodes:
        node.nmt.state = "PRE-OPERATIONAL"
        for pdo, names, transmission in (
            (node.rpdo[1], ("controlword", "target velocity"), 255),
            (node.tpdo[1], ("statusword", "position"), 1),
        ):
            pdo.read()
            pdo.clear()
            for name in names:
                pdo.add_variable(name)
            pdo.trans_type, pdo.enabled = transmission, True
            pdo.save()
        node.setup_402_state_machine()
    network.sync.start(0.02)
    for node in nodes:
        node.nmt.state = "OPERATIONAL"
        node.op_mode = "PROFILED VELOCITY"
        node.state = "OPERATION ENABLED"
    for node, way in zip(nodes, (1, -1), strict=True):
        node.rpdo[1]["target velocity"].raw = way * 1000
        node.rpdo[1].transmit()
    # 100 rpm of the motors, a gear of 20 and wheels of 0.1 m.
    speed = 100 / 60 / 20 * 2 * math.pi * 0.1
    made.until(lambda: made.speed() == pytest.approx(speed, rel=1e-3))
    made.until(lambda: [node.sdo["velocity"].raw for node in nodes] == [1000, -1000])
    for node in nodes:
        node.state = "QUICK STOP ACTIVE"
    made.until(lambda: made.speed() == 0.0)
    for node in nodes:
        node.state = "SWITCH ON DISABLED"
        assert node.state == "SWITCH ON DISABLED"
