"""A Robotiq-style claw on its socket: what it finds is the evidence, whatever was commanded."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import pytest
from pyrobotiqur import RobotiqGripper

from drivers.claw import robotiq
from drivers.claw.make import RobotiqClawConfig
from drivers.claw.robotiq import RobotiqClaw
from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceFault, InterlockError, NotConnectedError
from sim_backends.peers.server import TcpServer
from sim_backends.peers.switches import RobotiqPeer
from sim_backends.world.drawing import STOCK
from sim_backends.world.world import World

pytestmark = pytest.mark.wire

SPEED = 5.0


def opened(address: str, clock: Clock, *, control: bool = True, **changed: Any) -> RobotiqClaw:
    record = RobotiqClawConfig(address=address, speed=255, force=100, **changed)
    return RobotiqClaw("claw", record, clock=clock, control=control)


@dataclass
class Bench:
    world: World
    peer: RobotiqPeer
    clock: Clock

    def claw(self, *, control: bool = True, **changed: Any) -> RobotiqClaw:
        return opened(self.peer.address, self.clock, control=control, **changed)


@pytest.fixture
def bench() -> Iterator[Bench]:
    """The gripper of an ideal world whose arm lives on."""
    cell = replace(STOCK.cell, claw_output=None, grip_input=None)
    world = World(1, "ideal", SPEED, replace(STOCK, cell=cell))
    peer = RobotiqPeer(world, world.clock)
    over = threading.Event()

    def live() -> None:
        while not over.wait(0.004):
            world.arm.tick(world.clock.now())

    alive = threading.Thread(target=live)
    alive.start()
    peer.start()
    yield Bench(world, peer, Clock(SPEED))
    over.set()
    peer.stop()
    alive.join()


def test_a_part_is_held_because_the_gripper_found_it(bench: Bench):
    """Let go and closed again on nothing, the fingers go all the way: commanded closed, and nothing held."""
    claw = bench.claw()
    assert claw.holding
    claw.grip()
    assert claw.holding
    claw.release()
    assert not claw.holding
    assert not bench.world.part.held
    with pytest.raises(DeviceFault, match="met nothing") as met:
        claw.grip()
    assert met.value.code == "claw.no_part"
    assert not claw.holding
    claw.close()
    with pytest.raises(NotConnectedError):
        claw.ping()


def test_fingers_that_are_stopped_too_early_do_not_hold_from_inside(bench: Bench):
    """Stopped while closing is no grip of a part that is held by spreading."""
    claw = bench.claw(open_at=255, closed_at=0, inside=True)
    assert not claw.holding
    with pytest.raises(DeviceFault, match=r"claw\.stuck"):
        claw.release(1.0)
    claw.close()


def test_another_client_agrees_with_the_simulated_gripper_and_with_the_driver(bench: Bench):
    host, port = bench.peer.address.split(":")
    claw = bench.claw()
    with RobotiqGripper(host, int(port)) as other:
        assert (other.get_status(), other.get_object_status(), other.get_fault()) == (3, 2, 0)
        assert other.open(speed=255) == (0, 3)
        assert not claw.holding
        other.set_var("ACT", 0)
        with pytest.raises(DeviceFault, match="pendant") as met:
            claw.grip()
        assert met.value.code == "claw.not_active"
        other.activate(poll_interval=0.02)
    assert not claw.holding
    claw.close()


def test_a_fault_is_told_and_nothing_is_held_by_a_gripper_that_has_one(bench: Bench):
    claw = bench.claw()
    bench.peer.fault("claw.overcurrent")
    for ask in (lambda: claw.holding, claw.grip, claw.release):
        with pytest.raises(DeviceFault, match="too much current") as met:
            ask()
        assert met.value.code == "claw.fault"
    assert bench.world.part.held
    assert [reading.ok for reading in claw.examine(0.0)] == [True, False]
    claw.close()


def test_a_lost_connection_changes_nothing_and_the_next_question_makes_it_anew(bench: Bench):
    claw = bench.claw()
    bench.peer.fault("claw.link_lost")
    Clock().sleep(0.05)
    with pytest.raises(DeviceFault) as met:
        _ = claw.holding
    assert (met.value.code, met.value.recoverable) == ("claw.link_lost", True)
    assert claw.holding
    claw.close()


def test_who_only_looks_moves_no_finger(bench: Bench):
    claw = bench.claw(control=False)
    for ask in (claw.grip, claw.release):
        with pytest.raises(InterlockError):
            ask()
    assert claw.holding
    claw.close()


def test_what_is_no_gripper_is_told(monkeypatch):
    monkeypatch.setattr(robotiq, "REPLY_TIMEOUT_S", 0.2)
    silly = TcpServer("silly", lambda link: [link.sendall(b"hello") for _ in iter(lambda: link.recv(99), b"")])  # type: ignore[arg-type, return-value]
    silly.start()
    with pytest.raises(DeadlineError, match="b'hello' came"):
        opened(silly.address, Clock())
    silly.stop()
    babbling = TcpServer("babbling", lambda link: [link.sendall(b"x" * 200) for _ in iter(int, 1)])  # type: ignore[arg-type, return-value]
    babbling.start()
    with pytest.raises(DeadlineError):
        opened(babbling.address, Clock())
    babbling.stop()
    with pytest.raises(NotConnectedError, match="takes no connection"):
        opened(silly.address, Clock())
