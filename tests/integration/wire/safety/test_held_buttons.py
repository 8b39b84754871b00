"""A button held at a page moves a simulated arm and rail over their wires; whatever ends it, they stand within 250 ms,
by the simulated world's own knowledge."""

import itertools
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from websockets.sync.client import ClientConnection

from cell.apps.console.host.console import Console
from cell.run.session.supervisor import Cell
from drivers.clock import Clock
from tests.support import until
from tests.support.console.server import Browser

pytestmark = [pytest.mark.wire, pytest.mark.campaign]

WITHIN_S = 0.25
BEAT_S = 0.08
NUMBERS = itertools.count(1)


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Iterator[Cell]:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("cell"))
        with Cell.open(sim="all", seed=3, speed=1.0) as opened:
            opened.home()
            yield opened


def moving(cell: Cell, device: str) -> bool:
    assert cell.simulated is not None
    truth = cell.simulated.truth()
    return bool(truth["rail_moving"] if device == "rail" else truth["arm"]["moving"])


def beat(page: ClientConnection, device: str, axis: str, sign: int, over: threading.Event) -> float:
    """Hold a button until `over`; when the last beat was sent."""
    message = json.dumps({"type": "jog", "press": next(NUMBERS), "device": device, "axis": axis, "sign": sign})
    while True:
        page.send(message)
        sent = time.monotonic()
        if over.wait(BEAT_S):
            return sent


@pytest.mark.parametrize(("device", "axis"), [("arm", "z"), ("arm", "j1"), ("rail", "")])
@pytest.mark.parametrize("end", ["silence", "release", "page closed", "server frozen", "server killed", "stop"])
def test_a_held_button_ends_in_time(cell: Cell, device: str, axis: str, end: str):
    if not cell.devices.gate.is_open:
        cell.clear_stop("the test")
    sign = 1 if next(NUMBERS) % 2 else -1
    with Console(cell) as console:
        browser = Browser(console.link)
        page = browser.live()
        key = json.loads(page.recv(timeout=10))["key"]
        assert browser.do(do="hold", name="Ann", key=key).status == 200
        assert browser.do(do="manual", on=True, key=key).status == 200
        over, sent = threading.Event(), []
        holding = threading.Thread(target=lambda: sent.append(beat(page, device, axis, sign, over)), daemon=True)
        holding.start()
        assert until(lambda: moving(cell, device))
        Clock().sleep(0.2)
        ends: dict[str, Callable[[], object]] = {
            "silence": over.set,
            "release": lambda: page.send('{"type": "jog_end"}'),
            "page closed": lambda: page.socket.close(),
            "server frozen": lambda: os.kill(console._server._process.pid, signal.SIGSTOP),
            "server killed": lambda: os.kill(console._server._process.pid, signal.SIGKILL),
            "stop": lambda: page.send('{"type": "stop"}'),
        }
        assert moving(cell, device)
        ends[end]()
        begun = time.monotonic()
        stood = _stands_after(lambda: moving(cell, device), begun)
        over.set()
        if end == "silence":
            holding.join(2.0)
            stood += begun - sent[0]
        print(f"{device} {axis} {end}: {1e3 * stood:.0f} ms")
        if end == "server frozen":
            os.kill(console._server._process.pid, signal.SIGCONT)
        assert stood < WITHIN_S


def _stands_after(moves: Callable[[], bool], begun: float) -> float:
    stood: float | None = None
    while time.monotonic() - begun < 1.0:
        at = time.monotonic()
        if moves():
            stood = None
        elif stood is None:
            stood = at - begun
    assert stood is not None, "it still moves after a second"
    return stood
