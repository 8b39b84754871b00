"""Who may talk to the console's server: by clients that know nothing of it (docs/reference/console.md, "Who may")."""

import json
import queue
import random
import socket
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection

from cell.apps.console.host.console import Console
from cell.apps.console.host.link import Answer, Beat, Do, Joined, Left
from cell.apps.console.server.access import COMMANDS, MESSAGES, Access
from cell.run.session.supervisor import Cell
from tests.support.console.server import Served, serving

ODD: list[Any] = [
    10**400, -(10**400), 1e308, float("nan"), float("inf"), -0.0, 2**63, True, None, "", "x" * 3000, "\ud800", "\x00",
    "../../etc/passwd", "/dev/zero", "pot.toml", "é" * 500, [], {}, [[[[]]]], {"a": {"b": []}}, "c1", "arm", 1, -1, 0.5,
]  # fmt: skip
NAMES = [
    "job", "until", "at_start", "run", "seed", "name", "to", "by", "number", "choice", "step", "reason", "device",
    "axis", "amount", "fraction", "share", "on", "press", "sign", "at", "key", "type", "do", "__class__",
]  # fmt: skip
# Those that begin something long, or begin it anew, are said with something wrong in them.
HARMLESS = ["hold", "leave", "hand_over", "clear_stop", "pause", "go_on", "abort", "decide", "speed", "pace"]


def words(chance: random.Random, kind: str, names: list[str]) -> dict[str, Any]:
    """One command or message: of a known name nine times in ten, with known and unknown keys and odd values."""
    name = chance.choice(names) if chance.random() < 0.9 else chance.choice([*ODD, "explode"])
    said = {chance.choice(NAMES): chance.choice(ODD) for _ in range(chance.randrange(5))}
    if kind == "type":
        said = {"press": chance.randrange(9), "device": "arm", "axis": "z", "sign": 1, "at": 1.0} | said
    if name not in (*HARMLESS, *MESSAGES):
        said["surplus"] = 1
    return {**said, kind: name}


def desk_hears(console: Console, count: int) -> None:
    """Each command is answered and each message taken; in the order in which they are said."""
    chance, told = random.Random(22), queue.SimpleQueue[Any]()
    console._server.notify = told.put  # type: ignore[method-assign]
    for client in ("c1", "c2"):
        console._heard(Joined(client))
    for number in range(count):
        client = chance.choice(["c1", "c2"])
        if chance.random() < 0.5:
            console._heard(Do(number, client, words(chance, "do", list(COMMANDS))))
            while not isinstance(answer := told.get(timeout=20), Answer):
                pass
            assert (answer.number, answer.status) in [(number, status) for status in (200, 400, 403, 409)], answer
        else:
            console._heard(Beat(client, words(chance, "type", list(MESSAGES)), end=chance.random() < 0.3))
    console._heard(Left("c1"))


def socket_hears(server: Served, count: int) -> None:
    """Each is answered by the server: a command with a status below 500, a message by nothing or a closed link."""
    chance, page = random.Random(23), None
    for number in range(count):
        if page is None:
            page, key = opened(server)
        if chance.random() < 0.1:
            body = json.dumps({"key": key, **words(chance, "do", list(COMMANDS))})
            status = server.ask("POST", "/api/do", mutated(chance, body)).status
            assert status in (200, 400, 403, 413, 429), (number, body, status)
        else:
            try:
                page.send(mutated(chance, json.dumps(words(chance, "type", list(MESSAGES)))))
                page.ping(ack_on_close=True).wait(10)
            except ConnectionClosed:
                page = None
        if number % 500 == 0:
            assert server.ask("GET", "/api/cell").status in (200, 429)
            assert server.do(do="stop").status == 200


def opened(server: Served) -> tuple[ClientConnection, str]:
    """A live link; of a new session where this one has opened too many."""
    try:
        page = server.live()
    except InvalidStatus:
        server.enter()
        page = server.live()
    return page, json.loads(page.recv(timeout=10))["key"]


def mutated(chance: random.Random, text: str) -> bytes | str:
    """The text, every third time with bytes changed, cut off or doubled."""
    data = bytearray(text.encode("utf-8", "surrogatepass"))
    way = chance.randrange(9)
    at = chance.randrange(len(data))
    if way == 0:
        data[at] = chance.randrange(256)
    elif way == 1:
        del data[at:]
    elif way == 2:
        data[at:at] = data[:at]
    return bytes(data) if chance.random() < 0.1 else data.decode("utf-8", "replace")


COUNTS = pytest.mark.parametrize("count", [600, pytest.param(50_000, marks=pytest.mark.campaign)])


@COUNTS
def test_the_controller_answers_whatever_is_said(cell: Cell, count: int):
    with Console(cell, "pot") as console:
        desk_hears(console, count)


@COUNTS
def test_the_server_answers_whatever_is_said(tmp_path, count: int):
    with serving(tmp_path) as server:
        socket_hears(server, count)


TOKEN = "a-token-of-a-file-that-is-long-enough-0123456789"


def test_the_link_works_once_and_gives_a_cookie_that_no_script_sees(server: Served):
    _ = server.cookie
    link = server.tokens.get(timeout=10)
    first = server.ask("GET", f"/enter?token={link}", cookie=None)
    assert first.status == 200 and 'content="0;url=/#key=' in first.text
    cookie = first.headers["set-cookie"]
    assert cookie.startswith(f"cell_console_{server.port}=")
    assert all(word in cookie for word in ("HttpOnly", "SameSite=Strict", "Path=/"))
    again = server.ask("GET", f"/enter?token={link}", cookie=None)
    assert again.status == 403
    assert link not in again.text
    assert "set-cookie" not in again.headers


def test_a_link_works_once_also_before_the_next_is_made():
    access = Access(("127.0.0.1",), 1, secure=False)
    replaced, link = access.link(), access.link()
    assert access.enter(replaced) is None and access.enter(link) is not None
    assert access.enter(link) is None


@pytest.mark.parametrize("path", ["/", "/static/app.js", "/api/cell", "/api/runs", "/api/trend", "/nowhere"])
@pytest.mark.parametrize("cookie", [None, "cell_console=x", "a=b; cell_console_1=z", "\xff=\xfe", "x" * 5000])
def test_without_the_cookie_there_is_nothing(server: Served, path: str, cookie: str | None):
    assert server.ask("GET", path, cookie=cookie).status == 401


def test_a_cookie_alone_authorises_nothing(server: Served):
    """Another server on this address is sent the cookie; the key it is not. A second link leaves the first one be."""
    cookie, key = server.enter()
    second = server.enter()
    for path in ("/api/cell", "/api/runs", "/api/runs/20260101T000000-abcd/replay", "/api/runs/x/report.html?ticket="):
        for wrong in (None, "", "x", "none", key[:-1], cookie.partition("=")[2]):
            assert server.ask("GET", path, cookie=cookie, x_cell_key=wrong).status == 401
    before = server.stops
    assert server.ask("POST", "/api/do", '{"do": "stop"}', x_cell_key=None).status == 401
    assert server.ask("POST", "/api/do", '{"do": "stop"}', cookie=None, x_cell_key=key).status == 401
    for subprotocols in (None, ["cell"], ["cell", "x"], ["cell", key, "x"], [key]):
        with pytest.raises(InvalidStatus):
            server.live(subprotocols=subprotocols)
    assert server.stops == before
    # The cookie is the second's by now, as in a browser with two tabs.
    assert server.ask("GET", "/api/cell", cookie=second[0], x_cell_key=key).status == 200
    with server.live() as page:
        ticket = json.loads(page.recv(timeout=10))["ticket"]
    # A ticket shows pictures and reports, and nothing else; here there is none of that name.
    path = "/api/runs/20260101T000000-abcd"
    assert server.ask("GET", f"{path}/report.html?ticket={ticket}", x_cell_key=None).status == 404
    assert server.ask("GET", f"{path}/pictures/a.png?ticket={ticket}", x_cell_key=None).status == 404
    for other in (f"{path}?ticket={ticket}", f"{path}/replay?ticket={ticket}", f"/api/cell?ticket={ticket}"):
        assert server.ask("GET", other, x_cell_key=None).status == 401


@pytest.mark.parametrize("token", ["", "x", "é", "%00", "..%2f", "a" * 3000])
def test_a_wrong_token_opens_nothing(server: Served, token: str):
    path = "/enter?token=" + token if token.isascii() else "/enter?token=%C3%A9"
    assert server.ask("GET", path, cookie=None).status == 403


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:{port}", "127.0.0.1.evil.example:{port}",
     "127.0.0.1:{port}.evil.example", "evil@127.0.0.1:{port}", "[::1]:{port}", "0.0.0.0:{port}", "", None],
)  # fmt: skip
def test_another_name_is_not_answered(server: Served, host: str | None):
    """So that no name that somebody else gives this computer (DNS rebinding) reaches it."""
    given = None if host is None else host.format(port=server.port)
    # One without any is turned away by the protocol itself.
    assert server.ask("GET", "/api/cell", host=given).status == (400 if given is None else 421)
    assert server.ask("POST", "/api/do", '{"do": "stop"}', host=given).status in (400, 421)


def test_two_names_at_once_are_not_answered(server: Served):
    request = f"GET /api/cell HTTP/1.1\r\nHost: {server.host}\r\nHost: {server.host}\r\nCookie: {server.cookie}\r\n"
    request += f"X-Cell-Key: {server.key}\r\n\r\n"
    assert server.raw(request.encode()).startswith((b"HTTP/1.1 421", b"HTTP/1.1 400"))


STRANGERS = [
    "https://evil.example", "null", "", "http://127.0.0.1", "http://127.0.0.1:1", "https://127.0.0.1:{port}",
    "http://127.0.0.1:{port}.evil.example", "http://localhost.evil.example:{port}", "http://evil@127.0.0.1:{port}",
    "http://127.0.0.1:{port}/", "HTTP://127.0.0.1:{port}", "file://", "http://127.1:{port}", "http://[::1]:{port}",
]  # fmt: skip


@pytest.mark.parametrize("origin", [*STRANGERS, None])
def test_a_page_from_elsewhere_commands_nothing_and_sees_nothing(server: Served, origin: str | None):
    before, given = server.stops, None if origin is None else origin.format(port=server.port)
    assert (server.ask("POST", "/api/do", '{"do": "stop"}', origin=given).status, server.stops) == (403, before)
    with pytest.raises(InvalidStatus) as refused:
        server.live(origin=given)
    assert refused.value.response.status_code == 403
    if given is not None:
        assert server.ask("GET", "/api/cell", origin=given).status == 403


def test_a_browser_that_says_that_another_site_asks_is_refused(server: Served):
    assert server.ask("GET", "/api/cell", sec_fetch_site="cross-site").status == 403
    assert server.ask("POST", "/api/do", '{"do": "stop"}', sec_fetch_site="same-site").status == 403
    assert server.ask("GET", "/api/cell", sec_fetch_site="same-origin").status == 200


def test_the_live_link_asks_the_same(server: Served):
    link = socket.create_connection(("127.0.0.1", server.port))
    for options in ({"headers": {"cookie": "x=y"}}, {"url": f"ws://evil.example:{server.port}/live", "sock": link}):
        with pytest.raises(InvalidStatus) as refused:
            server.live(**options)
        assert refused.value.response.status_code == 403


def test_the_token_is_in_no_output_and_no_error(tmp_path, capfd):
    with serving(tmp_path, TOKEN) as server:
        for path in (f"/enter?token={TOKEN}x", f"/nowhere?token={TOKEN}", f"/static/{TOKEN}", f"/api/runs/{TOKEN}"):
            assert TOKEN not in server.ask("GET", path, cookie=None).text
        # That of a file works again and again.
        for _ in range(2):
            assert server.ask("GET", f"/enter?token={TOKEN}", cookie=None).status == 200
        server.raw(f"GET /enter?token={TOKEN} HTP/9\r\n\r\n".encode())
    out, error = capfd.readouterr()
    assert TOKEN not in out + error
