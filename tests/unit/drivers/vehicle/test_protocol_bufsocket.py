"""Promises of `drivers.vehicle.protocol_bufsocket`."""

import socket

import pytest
import serial

from drivers.vehicle.can_link import SCHEME

pytestmark = pytest.mark.wire


def test_a_writer_that_was_not_run_for_long_is_not_a_stuck_adapter():
    """What the other end took at once was not late; one that takes nothing is."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = serial.serial_for_url(f"{SCHEME}127.0.0.1:{server.getsockname()[1]}", write_timeout=1e-9)
        other, _ = server.accept()
        with other:
            for _ in range(200):
                assert port.write(b"t1118\r") == 6
            assert other.recv(5) == b"t1118"
            port.write_timeout = 0.05
            with pytest.raises(serial.SerialTimeoutException):
                for _ in range(1000):
                    port.write(bytes(65536))
            other.shutdown(socket.SHUT_RDWR)
        with pytest.raises(serial.SerialException):
            for _ in range(1000):
                port.write(b"t1118\r")
        port.close()
