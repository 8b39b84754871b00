"""URScript's socket commands at a server of the test."""

import socket

from sim_backends.peers.arm.program import RuntimeState
from tests.support.simulator.script_controller import Controller, program


def test_a_script_talks_with_a_server_and_only_on_loopback(controller: Controller):
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    controller.program.load(
        program(
            'textmsg(socket_open("192.0.2.1", 5))',
            f'textmsg(socket_open("127.0.0.1", {port}, "s"))',
            'textmsg(socket_read_binary_integer(2, "s", 0.01))',
            'socket_send_line("hello", "s")',
            'socket_send_int(-2, "s")',
            'textmsg(socket_read_binary_integer(2, "s", 0))',
            'textmsg(socket_read_ascii_float(2, "s"))',
            'textmsg(socket_read_string("s", "<", ">"))',
        )
    )
    controller.cycles(20)
    connection = server.accept()[0]
    assert connection.recv(100) == b"hello\n\xff\xff\xff\xfe"
    assert controller.program.runtime_state is RuntimeState.PLAYING
    connection.sendall(b"\0\0\0\7\xff\xff\xff\xff(1.5, 2)<ok>")
    controller.cycles(10)
    connection.close()
    server.close()
    assert controller.said() == ["False", "True", "[0, 0, 0]", "[2, 7, -1]", "[2, 1.5, 2]", "ok"]
