"""The console of a cell, its server and a page together: what is said arrives, STOP before all."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cell.apps.cli.commands.console import page_teller
from cell.apps.console.host.console import Address, Console
from cell.run.session.supervisor import Cell
from drivers.errors import ConfigError
from tests.support.console.server import Browser, until


@pytest.fixture
def gone() -> threading.Event:
    return threading.Event()


@pytest.fixture
def console(cell: Cell, gone: threading.Event) -> Iterator[Console]:
    with Console(cell, "pot", gone=gone.set) as made:
        yield made
    if not cell.devices.gate.is_open:
        cell.clear_stop("the test")


def state(page: Any, true: Any) -> dict[str, Any]:
    """The next state that is so."""
    while True:
        said = page.recv(timeout=20)
        if isinstance(said, str) and (told := json.loads(said))["type"] == "state" and true(told):
            return told


def test_a_page_sees_holds_and_stops_and_another_one_takes_over(cell: Cell, console: Console) -> None:
    ann = Browser(console.link)
    assert ann.ask("GET", "/api/cell").words["name"] == cell.config.cell.name
    assert ann.ask("GET", "/api/cell?job=seat").words["job"] == "seat"
    assert ann.ask("GET", "/api/cell?job=none").status == 400
    before = console.link
    with ann.live() as first, ann.live() as second:
        key, other = (json.loads(page.recv(timeout=20))["key"] for page in (first, second))
        assert ann.do(do="hold", name="Ann", key=key).words["text"] == "Ann holds the cell"
        assert ann.do(do="manual", on=True, key=other).status == 403
        assert ann.do(do="manual", on=True, key=key).status == 200
        assert ann.do(do="start", job="pot", key=key).status == 409
        told = state(first, lambda told: told["manual"])
        assert (told["run"]["kind"], [row["name"] for row in told["clients"]]) == ("jog", ["Ann", ""])
        # The one that does not hold stops it.
        stops = cell.stops
        second.send('{"type": "stop"}')
        assert until(lambda: cell.stops == stops + 1)
        told = state(first, lambda told: not told["manual"] and told["last"])
        assert told["safety"]["stopped"]
        assert told["last"]["outcome"] == "aborted"
        assert ann.do(do="hand_over", to=told["clients"][1]["id"], key=key).status == 200
        assert ann.do(do="clear_stop", by="Bob", key=other).status == 200
        state(second, lambda seen: not seen["safety"]["stopped"] and seen["holder"] == told["clients"][1]["id"])
    assert until(lambda: not console.seen)
    assert console.link == before


def test_when_the_server_is_killed_the_program_hears_of_it_and_nobody_holds(
    cell: Cell, console: Console, gone: threading.Event
) -> None:
    ann = Browser(console.link)
    with ann.live() as page:
        key = json.loads(page.recv(timeout=20))["key"]
        ann.do(do="hold", name="Ann", key=key)
        ann.do(do="manual", on=True, key=key)
        assert console.desk.manual.on
        os.kill(console.server_pid, signal.SIGKILL)
        assert gone.wait(5)
        assert until(lambda: not console.desk.manual.on)
        assert console.desk.holders.holder is None


def test_a_message_that_goes_wrong_ends_nothing(cell: Cell, console: Console, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a handler raises: the next message is heard, and the held button is let go of."""

    def fail(*_: object) -> None:
        raise OverflowError("int too large to convert to float")

    ann = Browser(console.link)
    for name in ("beat", "joined"):
        monkeypatch.setattr(console.desk, name, fail)
    with ann.live() as page:
        key = json.loads(page.recv(timeout=20))["key"]
        page.send(json.dumps({"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1}))
        assert any('"refused"' in str(page.recv(timeout=20))[:200] for _ in range(200))
        assert ann.do(do="leave", key=key).status == 403


def test_the_server_ends_with_its_program(cell: Cell, console: Console) -> None:
    """Its pipes end, as they do when it is killed. While it was there, nobody else could have its port."""
    with pytest.raises(ConfigError, match="cannot listen"):
        Console(cell, "pot", Address(port=console.port))
    server = console._server
    for pipe in (server._pipe, server._stops):
        socket.socket(fileno=os.dup(pipe.fileno())).shutdown(socket.SHUT_RDWR)
    assert server._process.wait(5) is not None


def test_the_link_is_in_no_process_s_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    """The browser is given a file that nobody else may read, in a folder that nobody else may enter."""
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    tell = page_teller(open_page=True)
    for link in ("http://127.0.0.1:1/enter?token=first", "http://127.0.0.1:1/enter?token=second"):
        tell(link)
    (url,) = opened
    page = Path(url.removeprefix("file://"))
    assert "token" not in url and "token=first" in page.read_text()
    assert [path.stat().st_mode & 0o077 for path in (page, page.parent)] == [0, 0]


# --- where it listens ---


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.7", "::", "localhost"])
def test_another_address_needs_a_token_and_tls(tmp_path: Path, host: str) -> None:
    token = tmp_path / "token"
    token.write_text("x" * 40)
    token.chmod(0o600)
    for address in (Address(host), Address(host, token_file=token), Address(host, certificate=token, key=token)):
        with pytest.raises(ConfigError):
            address.checked()


@pytest.mark.parametrize(("text", "mode"), [("short", 0o600), ("x" * 40, 0o644), ("", 0o600), ("x y" * 20, 0o600)])
def test_a_token_that_others_know_or_guess_is_refused_and_not_shown(tmp_path: Path, text: str, mode: int) -> None:
    token = tmp_path / "token"
    token.write_text(text)
    token.chmod(mode)
    with pytest.raises(ConfigError) as refused:
        Address(token_file=token).checked()
    assert not text or text not in str(refused.value)
