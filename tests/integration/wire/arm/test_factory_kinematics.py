"""The controller's own kinematics over its wires: read, planned with, compared; what is done where it is not told."""

import socket
import struct
import threading
from contextlib import closing

import numpy as np
import pinocchio as pin
import pytest

from cell.devices.diagnosis.diagnosis import _arm_state
from cell.measure.geometry.poses import to_ur
from cell.motion.kinematics import arm_kinematics
from drivers.arm.factory import parse_kinematics_info, read_factory_kinematics
from drivers.arm.ur import UrArm
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceFault
from drivers.interfaces import why_untold
from tests.support.wire.arm_bench import ArmBench
from tests.support.wire.cable import Cable

pytestmark = pytest.mark.wire

FACTORY = np.array(
    [
        [2e-4, -3e-4, -6e-4, 1e-7], [4e-4, 0.3, -1.2e-3, -1e-3], [-4e-4, -0.2, 2.1e-3, 2e-3],
        [-1e-4, -0.0996, -1e-3, -8e-4], [1e-5, -2e-4, 9e-4, -4e-5], [0.0, -1e-4, 0.0, 1e-6],
    ]
)  # fmt: skip
"""a, d, alpha, joint offset, as a factory may have found them: the offsets of joints 2 to 4 nearly cancel."""


TOLD_SIZE = 220
TOLD = struct.pack(">6I24dI", *range(6), *(k / 8 for k in range(24)), 2)
"""A controller's kinematics info."""


def _package(kinematics):
    """A state package with this kinematics info in it."""
    return struct.pack(">iBIB", 10 + len(kinematics), 16, 5 + len(kinematics), 5) + kinematics


def forward_of(table):
    """The cell's model of a UR10e whose controller told `table`."""
    arm = arm_kinematics("UR10e", table)
    return lambda joints: to_ur(arm.fk(joints))


def connect(address):
    return UrArm("arm", address, forward_of=forward_of, clock=Clock())


def test_an_arm_is_moved_by_the_table_that_its_controller_tells():
    with ArmBench(factory=FACTORY) as bench, closing(connect(bench.address)) as arm:
        np.testing.assert_array_equal(
            arm.link_table().alpha, FACTORY[:, 2] + [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]
        )
        model, drawn = arm_kinematics("UR10e", arm.link_table()), arm_kinematics("UR10e", None)
        state = arm.state()
        goal = pin.SE3(np.eye(3), np.array([0.0, 0.02, -0.03])) * model.fk(state.joints)
        arm.move_joints(model.ik(goal, state.joints), 0.5, 1.0).wait(10.0)
        reached = arm.state()
        np.testing.assert_allclose(reached.flange, to_ur(goal), atol=1e-6)
        off = drawn.fk(reached.joints).actInv(goal)
        assert np.linalg.norm(off.translation) > 0.5e-3, "the maker's table would have missed"


def test_where_the_controller_tells_no_table_nothing_moves_unless_it_is_the_makers():
    with ArmBench(factory=FACTORY) as bench, Cable(bench.address, but=(30001,)) as cable:
        assert "30001" in read_factory_kinematics(cable.address, timeout=0.5).missing
        before = bench.ask("show")["q"]
        with pytest.raises(DeviceFault, match=r"own kinematics is not known \(port 30001 .*Open that port") as caught:
            connect(cable.address)
        assert caught.value.code == "arm.wrong_kinematics"
        assert bench.ask("show")["q"] == before
    with ArmBench() as bench, Cable(bench.address, but=(30001,)) as cable:
        arm = connect(cable.address)
        assert arm.link_table() is None
        assert "port 30001 of" in why_untold(arm)
        assert "own kinematics not told (port 30001 of" in _arm_state(arm)
        arm.move_joints(arm.state().joints + 0.02, 0.5, 1.0).wait(10.0)
        arm.close()


def test_an_arm_of_another_size_is_named_before_anything_is_sent_to_it():
    with ArmBench(model="UR5e") as bench, pytest.raises(ConfigError, match=r"The nearest model is UR5e"):
        connect(bench.address)


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        ((struct.pack(">iB", 5, 20),), "sent none within 0.5 s"),
        ((struct.pack(">iB", 3, 16),), "package of 3 bytes"),
        ((struct.pack(">iB", 15, 16) + struct.pack(">IB", 99, 5) + bytes(5),), "part of 99 bytes where 10 are left"),
        ((struct.pack(">iB", 70_000, 16),), "package of 70000 bytes"),
        ((_package(bytes(TOLD_SIZE)),), "not initialised; switch the arm on"),
        # What comes before the table does not hide it: in the same connection, or in the first of two.
        ((_package(TOLD[:100]) + _package(TOLD),), None),
        ((_package(bytes(TOLD_SIZE - 4) + struct.pack(">I", 0)) + _package(TOLD),), None),
        ((struct.pack(">iB", 3, 16), _package(TOLD)), None),
        ((b"", _package(TOLD)), None),
    ],
    ids=["none", "short", "part", "long", "not initialised",
         "one that is cut off", "one not initialised", "a broken stream", "silence"],
)  # fmt: skip
def test_what_a_port_sends_is_the_table_or_unknown_with_its_reason(sent, why):
    with _server() as server:
        threading.Thread(target=_send, args=(server, *sent), daemon=True).start()
        told = read_factory_kinematics(server.getsockname()[0], timeout=0.5 if why else 1.0)
    assert told.table == (None if why else parse_kinematics_info(TOLD)), told.missing
    assert why is None or why in told.missing


def _server():
    """A listening port 30001 on an address that nobody uses."""
    for number in range(2, 255):
        try:
            return socket.create_server((f"127.0.4.{number}", 30001))
        except OSError:
            continue
    raise AssertionError("no address is free")


def _send(server, *sent):
    """Tell one client after the other this, and wait for each to leave."""
    for each in sent:
        with server.accept()[0] as connection:
            connection.sendall(each)
            connection.recv(1)
