"""What the server answers, and what it refuses: sizes, forms, paths; a STOP waits for nothing."""

import json
import socket
import time
from contextlib import ExitStack

import pytest

from tests.support import until
from tests.support.console.server import Served


def test_names_that_are_too_long_are_refused_in_words(server: Served):
    long, run = "x" * 5000, "/api/runs/20260101T000000-abcd"
    for path in (f"/api/runs/{long}", f"{run}/pictures/{long}.png", f"/static/{long}", f"/api/cell?job={long}"):
        assert server.ask("GET", path).status == 400
    with server.live() as page:
        key = json.loads(page.recv(timeout=10))["key"]
        for words in ({"do": "hold", "name": "x" * 3000}, {"do": "pace", "share": 10**400}, {"do": "start", "job": 3}):
            refused = server.do(key=key, **words)
            assert (refused.status, refused.words["error"]) == (400, "ConfigError")


def test_what_is_half_said_is_closed_within_ten_seconds(server: Served):
    """Half a head, half a body, half a second request, a refused one's body that never comes."""
    head = server.head()
    half = "Content-Length: 100\r\n\r\n{"
    whole = 'Content-Length: 13\r\n\r\n{"do": "stop"}'
    with ExitStack() as links:
        opened, put = [], head.replace("POST", "PUT")
        for sent in ("GET /api/cell HTTP/1.1\r\nHost:", head + half, head + whole + head, put + half):
            link = links.enter_context(socket.create_connection(("127.0.0.1", server.port)))
            link.sendall(sent.encode())
            opened.append(link)
        closed_by = time.monotonic() + 10.0
        for link in opened:
            link.settimeout(max(0.1, closed_by - time.monotonic()))
            while link.recv(4096):
                pass


def test_every_answer_lets_the_page_load_nothing_from_elsewhere(server: Served):
    for answer in (server.ask("GET", "/"), server.ask("GET", "/nowhere"), server.ask("GET", "/", cookie=None)):
        assert answer.headers["content-security-policy"].startswith("default-src 'self';")
        assert "unsafe" not in answer.headers["content-security-policy"]
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize("method", ["GET", "HEAD", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_only_a_post_changes_anything(server: Served, method: str):
    before = server.stops
    assert server.ask(method, "/api/do?do=stop", '{"do": "stop"}', origin=server.origin).status in (401, 405)
    assert server.stops == before


def test_a_form_of_another_page_is_no_command(server: Served):
    before = server.stops
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", None):
        assert server.ask("POST", "/api/do", '{"do": "stop"}', content_type=kind).status == 415
    assert server.stops == before


@pytest.mark.parametrize("body", [b"", b"[]", b"1", b"{", b'{"do": ', b"\xff\xfe", b"[" * 4000, b'"stop"', b"null"])
def test_what_is_not_understood_is_refused(server: Served, body: bytes):
    assert server.ask("POST", "/api/do", body).status == 400


def test_a_command_has_a_largest_size_also_when_it_does_not_say_its_own(server: Served):
    assert server.ask("POST", "/api/do", json.dumps({"do": "x" * 5000})).status == 413
    head, part = server.head("POST /api/do", "Transfer-Encoding: chunked", ""), b"1000\r\n" + b"x" * 4096 + b"\r\n"
    assert server.raw(head.encode() + 2 * part).startswith(b"HTTP/1.1 413")


def test_a_command_needs_the_key_of_a_live_link_and_a_stop_does_not(server: Served):
    with server.live() as page:
        hello = json.loads(page.recv(timeout=10))
        assert (server.do(do="pause").status, server.do(do="pause", key="x" * 32).status) == (403, 403)
        assert server.do(do="pause", key=hello["key"]).words == {"ok": True, "text": "pause"}
        server.forget()
        before = server.stops
        assert server.do(do="stop").words["ok"]
        page.send('{"type": "stop"}')
        assert until(lambda: server.stops == before + 2)
        assert server.heard.empty()
    server.trouble = "rail stopped: no answer"
    assert (server.do(do="stop").status, server.do(do="stop").words["text"]) == (500, server.trouble)
    server.trouble = None


def test_a_stop_waits_for_nothing_that_is_under_way(server: Served):
    """Commands that nobody answers keep it back no more than too many of them do."""
    with server.live() as page:
        key = json.loads(page.recv(timeout=10))["key"]
        links = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(30)]
        body = json.dumps({"do": "diag", "key": key})
        head = server.head("POST /api/do", f"Content-Length: {len(body)}", "")
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


def test_two_hundred_connections_keep_nobody_out(server: Served):
    with ExitStack() as links:
        idle = [links.enter_context(socket.create_connection(("127.0.0.1", server.port))) for _ in range(200)]
        begun = time.monotonic()
        before = server.stops
        assert (server.do(do="stop").status, server.stops) == (200, before + 1)
        assert time.monotonic() - begun < 2.0
        # Those who say nothing are sent away.
        idle[0].settimeout(15.0)
        assert idle[0].recv(1) == b""


@pytest.mark.parametrize(
    "path",
    ["/static/../serve.py", "/static/%2e%2e/serve.py", "/static/..%2fserve.py", "/api/runs/..%2f..%2fetc/replay",
     "/api/runs/20260101T000000-abcd/pictures/..%2f..%2fsecret.png", "/static//etc/passwd", "/api/runs/%00"],
)  # fmt: skip
def test_no_path_leads_out(server: Served, path: str):
    assert server.ask("GET", path).status == 404
