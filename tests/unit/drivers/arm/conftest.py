"""A dashboard server, and an arm with its driver over the wires, one for each file."""

from __future__ import annotations

import itertools
import socket

import pytest

from drivers.arm.ur import UrArm
from drivers.clock import Clock
from tests.support.wire.shared_arm import shared_arm


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


def connect(address):
    return UrArm("arm", address, safe_off_outputs=(0,), payload=(1.5, (0.0, 0.0, 0.06)), clock=Clock())


running, shared, bench, arm = shared_arm(connect, table=0.5)
