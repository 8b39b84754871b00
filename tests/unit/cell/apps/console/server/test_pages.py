"""Pages that talk nonsense, too much or not at all, read slowly, or are too many."""

import asyncio
import json
import socket
import time
from contextlib import ExitStack

import pytest
from websockets.exceptions import ConnectionClosed

from cell.apps.console.host.link import Beat, CloudPart, Joined, Left, Show
from cell.apps.console.server.pages import MOST_CLOUDS, Mailbox
from cell.apps.console.server.serve import PING_S
from tests.support.console.server import Served


@pytest.mark.parametrize(
    ("said", "code"),
    [(json.dumps({"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1, "at": 10**400}), 1007),
     ('{"type": "jog", "press": 1}', 1007), ('{"type": "jog_end", "press": -1}', 1007), ("x" * 1100, 1009),
     ("[]", 1007), ("{", 1007), ('{"type": 1}', 1007), ('{"type": "do"}', 1007), (b"\0\1", 1007),
     ('{"type": ' + "[" * 900, 1007)],
)  # fmt: skip
def test_a_page_that_talks_nonsense_is_put_out(server: Served, said: str | bytes, code: int):
    with server.live() as page:
        page.recv(timeout=10)
        page.send(said)
        with pytest.raises(ConnectionClosed) as closed:
            page.recv(timeout=10)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == code


@pytest.mark.parametrize("said", ['{"type": "jog_end", "press": 1}', '{"type": "stop"}'])
def test_a_page_that_talks_too_much_is_put_out_and_lets_go(server: Served, said: str):
    server.forget()
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


def test_a_page_that_is_lost_without_a_word_lets_go_within_seconds(server: Served):
    """Its cable is out: nothing is closed, nothing answers. Nobody else could take hold until it is given up."""
    server.forget()
    upgrade = "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"
    key = f"Sec-WebSocket-Key: {'a' * 22}==", f"Sec-WebSocket-Protocol: cell, {server.key}"
    ask = server.head("GET /live", *upgrade, *key, "")
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as lost:
        lost.sendall(ask.encode())
        joined = server.heard.get(timeout=20)
        while not isinstance(joined, Joined):
            joined = server.heard.get(timeout=20)
        assert server.heard.get(timeout=2.5 * PING_S) == Left(joined.client)


def test_broken_frames_and_half_an_upgrade_hurt_nobody(server: Served):
    with server.live() as page:
        page.recv(timeout=10)
        page.socket.sendall(b"\xff\xff\xff\xff\xff\xff")
    server.raw(b"GET /live HTTP/1.1\r\nUpgrade: websocket\r\n\r\n")
    server.raw(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\0" * 300)
    server.raw(b"GET /" + b"a" * 20000 + b" HTTP/1.1\r\n")
    assert server.ask("GET", "/api/cell").status == 200


def test_more_pages_than_there_is_room_for_are_told_so(server: Served):
    with ExitStack() as pages:
        for _ in range(16):
            pages.enter_context(server.live()).recv(timeout=10)
        with pytest.raises(ConnectionClosed) as closed:
            pages.enter_context(server.live()).recv(timeout=10)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1013


def test_who_reads_slowly_sees_the_newest_and_holds_nobody_up(server: Served):
    """The state and pictures: the newest. The cloud: every increment, up to a bound."""
    big = "x" * 60_000
    # What it never reads would keep its close waiting.
    with server.live(max_queue=1, close_timeout=0.1) as slow, server.live() as quick:
        for page in (slow, quick):
            page.recv(timeout=10)
        for n in range(150):
            server.process.notify(Show(json.dumps({"type": "state", "n": n, "fill": big})))
            time.sleep(0.004)
        server.process.notify(CloudPart({"type": "cloud", "reset": False}, b"\0" * 16))
        seen = _states(quick, 149)
        assert seen[-1] == 149
        late = _states(slow, 149)
        # What was on its way before it was slow, and then the newest: nothing old was kept for it.
        assert late[-1] == 149
        assert len(late) < len(seen)


def _states(page: object, last: int) -> list[int]:
    seen: list[int] = []
    while not seen or seen[-1] != last:
        said = page.recv(timeout=20)  # type: ignore[attr-defined]
        if isinstance(said, str) and '"state"' in said[:20]:
            seen.append(json.loads(said)["n"])
    return seen


def test_the_mailbox_keeps_the_newest_and_of_the_cloud_as_much_as_it_may():
    async def fill() -> list[str | bytes]:
        mailbox = Mailbox()
        for n in range(500):
            mailbox.show("state", f"state {n}")
            mailbox.cloud(n.to_bytes(2, "big"))
        mailbox.say("hello")
        return [await mailbox.take() for _ in range(2 + MOST_CLOUDS)]

    taken = asyncio.run(fill())
    assert taken[:2] == ["hello", "state 499"]
    assert taken[2:] == [n.to_bytes(2, "big") for n in range(500 - MOST_CLOUDS, 500)]
