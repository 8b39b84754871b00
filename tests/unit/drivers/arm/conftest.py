"""A dashboard server, and an arm with its driver over the wires, one for each file."""

import itertools
import socket
import threading
from contextlib import suppress

import pytest

from drivers.arm.dashboard import Dashboard
from drivers.arm.ur import UrArm
from drivers.clock import Clock
from tests.support.wire.shared_arm import shared_arm


@pytest.fixture
def dashboard():
    """Starts a dashboard server on a free loopback address that says `answer(question)`; None: nothing. Gives a
    connected dashboard of the driver's, and what it asks."""
    for number in itertools.count(200):
        with suppress(OSError):
            listener = socket.create_server((f"127.0.0.{number}", 29999))
            break

    def start(answer, timeout=1.0):
        asked = []

        def serve():
            with suppress(OSError):
                while True:
                    client, _ = listener.accept()
                    with client, client.makefile("r") as questions:
                        client.sendall(b"Connected\n")
                        for question in questions:
                            asked.append(question.strip())
                            if (told := answer(asked[-1])) is not None:
                                client.sendall(f"{told}\n".encode())
                            if asked[-1] == "quit":
                                break

        threading.Thread(target=serve, daemon=True).start()
        return Dashboard("arm", listener.getsockname()[0], timeout=timeout), asked

    yield start
    listener.close()


def connect(address):
    return UrArm("arm", address, safe_off_outputs=(0,), payload=(1.5, (0.0, 0.0, 0.06)), clock=Clock())


running, shared, bench, arm = shared_arm(connect, table=0.5)
