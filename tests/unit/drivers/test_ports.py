"""Promises of `drivers.ports`."""

import socket
import time

import pytest

from drivers.ports import SocketPort, open_port


def test_a_port_over_a_network_closes_at_once_and_is_opened_again_when_its_server_had_time():
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_server(("127.0.0.1", 0)) as other:
        first, second = (f"socket://127.0.0.1:{each.getsockname()[1]}" for each in (server, other))
        port = open_port("rail", first, baud=9600, timeout=1.0)
        begun = time.monotonic()
        port.close()
        port.close()
        # Its own connection may end late: another address is not waited for.
        open_port("rail", second, baud=9600, timeout=1.0).close()
        assert time.monotonic() - begun < 0.5 * SocketPort.REOPEN_S
        assert server.accept()[0].recv(1) == b"", "the other end is told"
        again = open_port("rail", first, baud=9600, timeout=1.0)
        assert time.monotonic() - begun >= SocketPort.REOPEN_S
        assert server.accept()[0].send(b"x") == 1 and again.read(1) == b"x"
        again.close()
        with pytest.raises(OSError, match="not open"):
            again.read(1)


def test_a_port_that_no_helper_can_hold_is_told(caplog):
    open_port("laser", "loop://", baud=9600, timeout=0.1).close()
    assert "laser: nobody will stop it if this process is killed: port loop://" in caplog.text
