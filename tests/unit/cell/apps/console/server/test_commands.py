"""What pages say at random: 100,000 commands and messages, whole, mutated and made up, each of them answered.

The generator has a fixed seed. Half go to a desk as the server would pass them on, half through the server's socket.
"""

from __future__ import annotations

import json
import queue
import random
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection

from cell.apps.console.host.console import Console
from cell.apps.console.host.link import Answer, Beat, Do, Joined, Left
from cell.apps.console.server.commands import COMMANDS, MESSAGES
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
def test_the_desk_answers_whatever_is_said(cell: Cell, count: int) -> None:
    with Console(cell, "pot") as console:
        desk_hears(console, count)


@COUNTS
def test_the_server_answers_whatever_is_said(tmp_path: Path, count: int) -> None:
    with serving(tmp_path) as server:
        socket_hears(server, count)
