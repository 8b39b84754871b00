"""A simulated arm and the real ur_rtde at it, and a controller without a network."""

from collections.abc import Iterator

import pytest

from tests.support.simulator.script_controller import Controller
from tests.support.simulator.ur_client import SPEED, Client
from tests.support.wire.arm_bench import ArmBench


@pytest.fixture(scope="module")
def session() -> Iterator[Client]:
    with ArmBench(speed=SPEED, unlock_delay=5.0) as simulator:
        client = Client(simulator)
        yield client
        client.control.stopScript()
        client.control.disconnect()
        client.io.disconnect()
        client.receive.disconnect()


@pytest.fixture
def arm(session: Client) -> Client:
    session.recover()
    return session


@pytest.fixture
def controller() -> Controller:
    return Controller()


@pytest.fixture(scope="module")
def running() -> Iterator[ArmBench]:
    with ArmBench() as bench:
        yield bench


@pytest.fixture
def address(running: ArmBench) -> str:
    running.ask("clear")
    running.ask("reset")
    return str(running.address)
