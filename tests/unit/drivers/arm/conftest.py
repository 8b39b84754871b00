"""A dashboard server, and an arm with its driver over the wires, one for each file."""

from __future__ import annotations

import itertools
import socket

import pytest

from drivers.arm.ur import UrArm
from drivers.clock import Clock
from drivers.errors import CellError
from tests.support.wire.arm_bench import ArmBench, stand_at_home


@pytest.fixture
def server():
    """A dashboard server on a free loopback address whose behaviour a test sets."""
    for number in itertools.count(200):
        listener = socket.socket()
        try:
            listener.bind((f"127.0.0.{number}", 29999))
            break
        except OSError:
            listener.close()
    listener.listen()
    yield listener
    listener.close()


LASER = 0


@pytest.fixture(scope="module")
def running():
    with ArmBench(table=0.5) as bench:
        yield bench


@pytest.fixture
def bench(running):
    running.ask("reset")
    return running


@pytest.fixture(scope="module")
def connected(running):
    arm = UrArm("arm", running.address, safe_off_outputs=(LASER,), payload=(1.5, (0.0, 0.0, 0.06)), clock=Clock())
    yield arm
    arm.close()


@pytest.fixture
def arm(bench, connected):
    """The driver, connected and ready, with the arm back where it began."""
    try:
        stand_at_home(connected)
    except CellError:
        connected.recover(confirmed=True)
        stand_at_home(connected)
    return connected
