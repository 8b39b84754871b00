"""Who may talk to the console's server: by clients that know nothing of it (docs/reference/console.md, "Who may")."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from websockets.exceptions import InvalidStatus

from cell.apps.console.server.access import Access
from tests.support.console.server import Served, serving

TOKEN = "a-token-of-a-file-that-is-long-enough-0123456789"


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
