"""Who may talk to the console's server: by clients that know nothing of it (docs/reference/console.md, "Who may")."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from cell.apps.console.messages import Beat, CloudPart, Joined, Left, Show
from cell.apps.console.server.access import Access
from cell.apps.console.server.serve import PING_S
from tests.support.console.server import Served, serving, until

TOKEN = "a-token-of-a-file-that-is-long-enough-0123456789"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving(tmp_path_factory.mktemp("runs")) as served:
        yield served


def forget(server: Served) -> None:
    while not server.heard.empty():
        server.heard.get()


# --- who comes in ---


def test_the_link_works_once_and_gives_a_cookie_that_no_script_sees(server: Served) -> None:
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


def test_a_link_works_once_also_before_the_next_is_made() -> None:
    access = Access(("127.0.0.1",), 1, secure=False)
    replaced, link = access.link(), access.link()
    assert access.enter(replaced) is None
    assert access.enter(link) is not None
    assert access.enter(link) is None


@pytest.mark.parametrize("path", ["/", "/static/app.js", "/api/cell", "/api/runs", "/api/trend", "/nowhere"])
@pytest.mark.parametrize("cookie", [None, "cell_console=x", "a=b; cell_console_1=z", "\xff=\xfe", "x" * 5000])
def test_without_the_cookie_there_is_nothing(server: Served, path: str, cookie: str | None) -> None:
    assert server.ask("GET", path, cookie=cookie).status == 401


def test_a_cookie_alone_authorises_nothing(server: Served) -> None:
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


def test_names_that_are_too_long_are_refused_in_words(server: Served) -> None:
    long, run = "x" * 5000, "/api/runs/20260101T000000-abcd"
    for path in (f"/api/runs/{long}", f"{run}/pictures/{long}.png", f"/static/{long}", f"/api/cell?job={long}"):
        assert server.ask("GET", path).status == 400
    with server.live() as page:
        key = json.loads(page.recv(timeout=10))["key"]
        for words in ({"do": "hold", "name": "x" * 3000}, {"do": "pace", "share": 10**400}, {"do": "start", "job": 3}):
            refused = server.do(key=key, **words)
            assert (refused.status, refused.words["error"]) == (400, "ConfigError")


def test_what_is_half_said_is_closed_within_ten_seconds(server: Served) -> None:
    """Half a head, half a body, half a second request, a refused one's body that never comes."""
    head = f"POST /api/do HTTP/1.1\r\nHost: {server.host}\r\nOrigin: {server.origin}\r\nCookie: {server.cookie}\r\n"
    head += f"Content-Type: application/json\r\nX-Cell-Key: {server.key}\r\n"
    half = "Content-Length: 100\r\n\r\n{"
    whole = 'Content-Length: 13\r\n\r\n{"do": "stop"}'
    with ExitStack() as links:
        opened = []
        for sent in (
            "GET /api/cell HTTP/1.1\r\nHost:",
            head + half,
            head + whole + head,
            head.replace("POST", "PUT") + half,
        ):
            link = links.enter_context(socket.create_connection(("127.0.0.1", server.port)))
            link.sendall(sent.encode())
            opened.append(link)
        closed_by = time.monotonic() + 10.0
        for link in opened:
            link.settimeout(max(0.1, closed_by - time.monotonic()))
            while link.recv(4096):
                pass


@pytest.mark.parametrize("token", ["", "x", "é", "%00", "..%2f", "a" * 3000])
def test_a_wrong_token_opens_nothing(server: Served, token: str) -> None:
    path = "/enter?token=" + token if token.isascii() else "/enter?token=%C3%A9"
    assert server.ask("GET", path, cookie=None).status == 403


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:{port}", "127.0.0.1.evil.example:{port}",
     "127.0.0.1:{port}.evil.example", "evil@127.0.0.1:{port}", "[::1]:{port}", "0.0.0.0:{port}", "", None],
)  # fmt: skip
def test_another_name_is_not_answered(server: Served, host: str | None) -> None:
    """So that no name that somebody else gives this computer (DNS rebinding) reaches it."""
    given = None if host is None else host.format(port=server.port)
    # One without any is turned away by the protocol itself.
    assert server.ask("GET", "/api/cell", host=given).status == (400 if given is None else 421)
    assert server.ask("POST", "/api/do", '{"do": "stop"}', host=given).status in (400, 421)


def test_two_names_at_once_are_not_answered(server: Served) -> None:
    request = f"GET /api/cell HTTP/1.1\r\nHost: {server.host}\r\nHost: {server.host}\r\nCookie: {server.cookie}\r\n"
    request += f"X-Cell-Key: {server.key}\r\n\r\n"
    assert server.raw(request.encode()).startswith((b"HTTP/1.1 421", b"HTTP/1.1 400"))


STRANGERS = [
    "https://evil.example", "null", "", "http://127.0.0.1", "http://127.0.0.1:1", "https://127.0.0.1:{port}",
    "http://127.0.0.1:{port}.evil.example", "http://localhost.evil.example:{port}", "http://evil@127.0.0.1:{port}",
    "http://127.0.0.1:{port}/", "HTTP://127.0.0.1:{port}", "file://", "http://127.1:{port}", "http://[::1]:{port}",
]  # fmt: skip


@pytest.mark.parametrize("origin", [*STRANGERS, None])
def test_a_page_from_elsewhere_commands_nothing_and_sees_nothing(server: Served, origin: str | None) -> None:
    before, given = server.stops, None if origin is None else origin.format(port=server.port)
    assert server.ask("POST", "/api/do", '{"do": "stop"}', origin=given).status == 403
    assert server.stops == before
    with pytest.raises(InvalidStatus) as refused:
        server.live(origin=given)
    assert refused.value.response.status_code == 403
    if given is not None:
        assert server.ask("GET", "/api/cell", origin=given).status == 403


def test_a_browser_that_says_that_another_site_asks_is_refused(server: Served) -> None:
    assert server.ask("GET", "/api/cell", sec_fetch_site="cross-site").status == 403
    assert server.ask("POST", "/api/do", '{"do": "stop"}', sec_fetch_site="same-site").status == 403
    assert server.ask("GET", "/api/cell", sec_fetch_site="same-origin").status == 200


@pytest.mark.parametrize("headers", [{"cookie": "x=y"}, {"host": "evil.example"}])
def test_the_live_link_asks_the_same(server: Served, headers: dict[str, str]) -> None:
    request = {"Host": server.host, "Cookie": server.cookie, "Origin": server.origin}
    request["Sec-WebSocket-Protocol"] = f"cell, {server.key}"
    request |= {name.title(): value for name, value in headers.items()}
    lines = [f"{name}: {value}" for name, value in request.items()]
    upgrade = ["GET /live HTTP/1.1", "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    said = server.raw("\r\n".join([*upgrade, "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", *lines, "", ""]).encode())
    assert said.startswith(b"HTTP/1.1 403")


def test_every_answer_lets_the_page_load_nothing_from_elsewhere(server: Served) -> None:
    for answer in (server.ask("GET", "/"), server.ask("GET", "/nowhere"), server.ask("GET", "/", cookie=None)):
        assert answer.headers["content-security-policy"].startswith("default-src 'self';")
        assert "unsafe" not in answer.headers["content-security-policy"]
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in answer.headers


# --- what is done ---


@pytest.mark.parametrize("method", ["GET", "HEAD", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_only_a_post_changes_anything(server: Served, method: str) -> None:
    before = server.stops
    assert server.ask(method, "/api/do?do=stop", '{"do": "stop"}', origin=server.origin).status in (401, 405)
    assert server.stops == before


def test_a_form_of_another_page_is_no_command(server: Served) -> None:
    before = server.stops
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", None):
        assert server.ask("POST", "/api/do", '{"do": "stop"}', content_type=kind).status == 415
    assert server.stops == before


@pytest.mark.parametrize("body", [b"", b"[]", b"1", b"{", b'{"do": ', b"\xff\xfe", b"[" * 4000, b'"stop"', b"null"])
def test_what_is_not_understood_is_refused(server: Served, body: bytes) -> None:
    assert server.ask("POST", "/api/do", body).status == 400


def test_a_command_has_a_largest_size_also_when_it_does_not_say_its_own(server: Served) -> None:
    assert server.ask("POST", "/api/do", json.dumps({"do": "x" * 5000})).status == 413
    head = f"POST /api/do HTTP/1.1\r\nHost: {server.host}\r\nOrigin: {server.origin}\r\nCookie: {server.cookie}\r\n"
    head += f"X-Cell-Key: {server.key}\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n"
    assert server.raw(head.encode() + b"1000\r\n" + b"x" * 4096 + b"\r\n1000\r\n" + b"x" * 4096 + b"\r\n").startswith(
        b"HTTP/1.1 413"
    )


def test_a_command_needs_the_key_of_a_live_link_and_a_stop_does_not(server: Served) -> None:
    with server.live() as page:
        hello = json.loads(page.recv(timeout=10))
        assert server.do(do="pause").status == 403
        assert server.do(do="pause", key="x" * 32).status == 403
        assert server.do(do="pause", key=hello["key"]).words == {"ok": True, "text": "pause"}
        forget(server)
        before = server.stops
        assert server.do(do="stop").words["ok"]
        page.send('{"type": "stop"}')
        assert until(lambda: server.stops == before + 2)
        assert server.heard.empty()
    server.trouble = "rail stopped: no answer"
    assert (server.do(do="stop").status, server.do(do="stop").words["text"]) == (500, server.trouble)
    server.trouble = None


def test_a_stop_waits_for_nothing_that_is_under_way(server: Served) -> None:
    """Commands that nobody answers keep it back no more than too many of them do."""
    with server.live() as page:
        key = json.loads(page.recv(timeout=10))["key"]
        links = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(30)]
        body = json.dumps({"do": "diag", "key": key})
        head = f"POST /api/do HTTP/1.1\r\nHost: {server.host}\r\nOrigin: {server.origin}\r\nCookie: {server.cookie}\r\n"
        head += f"X-Cell-Key: {server.key}\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        for link in links:
            link.sendall((head + body).encode())
        begun = time.monotonic()
        assert server.do(do="stop").status == 200
        assert time.monotonic() - begun < 2.0
        while (status := server.do(do="pause", key=key).status) == 200:
            pass
        assert status == 429
        assert server.do(do="stop").status == 200
        for link in links:
            link.close()


# --- what pages say ---


@pytest.mark.parametrize(
    ("said", "code"),
    [(json.dumps({"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1, "at": 10**400}), 1007),
     ('{"type": "jog", "press": 1}', 1007), ('{"type": "jog_end", "press": -1}', 1007), ("x" * 1100, 1009),
     ("[]", 1007), ("{", 1007), ('{"type": 1}', 1007), ('{"type": "do"}', 1007), (b"\0\1", 1007),
     ('{"type": ' + "[" * 900, 1007)],
)  # fmt: skip
def test_a_page_that_talks_nonsense_is_put_out(server: Served, said: str | bytes, code: int) -> None:
    with server.live() as page:
        page.recv(timeout=10)
        page.send(said)
        with pytest.raises(ConnectionClosed) as closed:
            page.recv(timeout=10)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == code


@pytest.mark.parametrize("said", ['{"type": "jog_end", "press": 1}', '{"type": "stop"}'])
def test_a_page_that_talks_too_much_is_put_out_and_lets_go(server: Served, said: str) -> None:
    forget(server)
    with server.live() as page:
        client = json.loads(page.recv(timeout=10))["id"]
        with pytest.raises(ConnectionClosed):
            for _ in range(2000):
                page.send(said)
                time.sleep(0.0005)
    heard: list[object] = []
    while not heard or heard[-1] != Left(client):
        heard.append(server.heard.get(timeout=20))
    assert Joined(client) in heard
    assert sum(isinstance(message, Beat) for message in heard) < 300


def test_a_page_that_is_lost_without_a_word_lets_go_within_seconds(server: Served) -> None:
    """Its cable is out: nothing is closed, nothing answers. Nobody else could take hold until it is given up."""
    forget(server)
    ask = (
        f"GET /live HTTP/1.1\r\nHost: {server.host}\r\nOrigin: {server.origin}\r\nCookie: {server.cookie}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: {'a' * 22}==\r\nSec-WebSocket-Protocol: cell, {server.key}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as lost:
        lost.sendall(ask.encode())
        joined = server.heard.get(timeout=20)
        while not isinstance(joined, Joined):
            joined = server.heard.get(timeout=20)
        assert server.heard.get(timeout=2.5 * PING_S) == Left(joined.client)


def test_broken_frames_and_half_an_upgrade_hurt_nobody(server: Served) -> None:
    with server.live() as page:
        page.recv(timeout=10)
        page.socket.sendall(b"\xff\xff\xff\xff\xff\xff")
    server.raw(b"GET /live HTTP/1.1\r\nUpgrade: websocket\r\n\r\n")
    server.raw(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\0" * 300)
    server.raw(b"GET /" + b"a" * 20000 + b" HTTP/1.1\r\n")
    assert server.ask("GET", "/api/cell").status == 200


# --- many, and slow ones ---


def test_two_hundred_connections_keep_nobody_out(server: Served) -> None:
    idle = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(200)]
    try:
        begun = time.monotonic()
        before = server.stops
        assert server.do(do="stop").status == 200
        assert server.stops == before + 1
        assert time.monotonic() - begun < 2.0
        # Those who say nothing are sent away.
        idle[0].settimeout(15.0)
        assert idle[0].recv(1) == b""
    finally:
        for link in idle:
            link.close()


def test_more_pages_than_there_is_room_for_are_told_so(server: Served) -> None:
    pages = []
    try:
        for _ in range(16):
            pages.append(server.live())
            pages[-1].recv(timeout=10)
        late = server.live()
        pages.append(late)
        with pytest.raises(ConnectionClosed) as closed:
            late.recv(timeout=10)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1013
    finally:
        for page in pages:
            page.close()


def test_who_reads_slowly_sees_the_newest_and_holds_nobody_up(server: Served) -> None:
    """The state and pictures: the newest. The cloud: every increment, up to a bound."""
    big = "x" * 60_000
    # What it never reads would keep its close waiting.
    slow = server.live(max_queue=1, close_timeout=0.1)
    quick = server.live()
    try:
        for page in (slow, quick):
            page.recv(timeout=10)
        for n in range(150):
            server.process.tell(Show(json.dumps({"type": "state", "n": n, "fill": big})))
            time.sleep(0.004)
        server.process.tell(CloudPart({"type": "cloud", "reset": False}, b"\0" * 16))
        seen = _states(quick, 149)
        assert seen[-1] == 149
        late = _states(slow, 149)
        # What was on its way before it was slow, and then the newest: nothing old was kept for it.
        assert late[-1] == 149
        assert len(late) < len(seen)
    finally:
        slow.close()
        quick.close()


def _states(page: object, last: int) -> list[int]:
    seen: list[int] = []
    while not seen or seen[-1] != last:
        said = page.recv(timeout=20)  # type: ignore[attr-defined]
        if isinstance(said, str) and '"state"' in said[:20]:
            seen.append(json.loads(said)["n"])
    return seen


# --- what is told to nobody ---


def test_the_token_is_in_no_output_and_no_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with serving(tmp_path, TOKEN) as server:
        for path in (f"/enter?token={TOKEN}x", f"/nowhere?token={TOKEN}", f"/static/{TOKEN}", f"/api/runs/{TOKEN}"):
            assert TOKEN not in server.ask("GET", path, cookie=None).text
        # That of a file works again and again.
        for _ in range(2):
            assert server.ask("GET", f"/enter?token={TOKEN}", cookie=None).status == 200
        server.raw(f"GET /enter?token={TOKEN} HTP/9\r\n\r\n".encode())
    out, error = capfd.readouterr()
    assert TOKEN not in out + error


@pytest.mark.parametrize(
    "path",
    ["/static/../serve.py", "/static/%2e%2e/serve.py", "/static/..%2fserve.py", "/api/runs/..%2f..%2fetc/replay",
     "/api/runs/20260101T000000-abcd/pictures/..%2f..%2fsecret.png", "/static//etc/passwd", "/api/runs/%00"],
)  # fmt: skip
def test_no_path_leads_out(server: Served, path: str) -> None:
    assert server.ask("GET", path).status == 404
