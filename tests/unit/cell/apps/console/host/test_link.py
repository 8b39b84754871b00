"""The pipes between a program and its server: whatever happens to one of them, the program hears of it."""

import json
import os
import signal
import socket
import threading

import pytest

from cell.apps.console.host.console import Address, Console
from cell.apps.console.host.link import Beat
from cell.run.session.supervisor import Cell
from drivers.errors import ConfigError
from tests.support import until
from tests.support.console.server import Browser


def test_when_the_server_is_killed_the_program_hears_of_it_and_nobody_holds(
    cell: Cell, console: Console, gone: threading.Event
):
    ann = Browser(console.link)
    with ann.live() as page:
        key = json.loads(page.recv(timeout=20))["key"]
        ann.do(do="hold", name="Ann", key=key)
        ann.do(do="manual", on=True, key=key)
        assert console.controller.manual.on
        os.kill(console._server._process.pid, signal.SIGKILL)
        assert gone.wait(5)
        assert until(lambda: not console.controller.manual.on)
        assert console.controller.holders.holder is None


def test_a_message_that_goes_wrong_ends_nothing(cell: Cell, console: Console, monkeypatch):
    """Whatever a handler raises: the next message is heard, and the held button is let go of."""

    def fail(*_: object) -> None:
        raise OverflowError("int too large to convert to float")

    ann = Browser(console.link)
    monkeypatch.setattr(console.controller, "beat", fail)
    monkeypatch.setattr(console.controller.holders, "joined", fail)
    with ann.live() as page:
        key = json.loads(page.recv(timeout=20))["key"]
        page.send(json.dumps({"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1}))
        assert any('"refused"' in str(page.recv(timeout=20))[:200] for _ in range(200))
        assert ann.do(do="leave", key=key).status == 403


def test_the_server_ends_with_its_program(cell: Cell, console: Console):
    """Its pipes end, as they do when it is killed. While it was there, nobody else could have its port."""
    with pytest.raises(ConfigError, match="cannot listen"):
        Console(cell, "pot", Address(port=console.port))
    server = console._server
    for pipe in (server._pipe, server._stops):
        socket.socket(fileno=os.dup(pipe.fileno())).shutdown(socket.SHUT_RDWR)
    assert server._process.wait(5) is not None


@pytest.mark.parametrize("hung", ["beat", "joined"])
def test_a_killed_server_is_noticed_whatever_the_other_threads_do(cell: Cell, hung: str, monkeypatch):
    """The thread that hears the server hangs in a message; another message is none that it could take."""
    gone, held = threading.Event(), threading.Event()
    with Console(cell, "pot", gone=gone.set) as console:
        console._heard(Beat("c1", {"type": "jog", "press": 1, "at": 10**400}))
        owner = console.controller.holders if hung == "joined" else console.controller
        monkeypatch.setattr(owner, hung, lambda *_: held.wait(60))
        browser = Browser(console.link)
        with browser.live() as page:
            page.send(json.dumps({"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1}))
            os.kill(console._server._process.pid, signal.SIGKILL)
            assert gone.wait(2.0)
        held.set()
