"""Nobody can deny a STOP: pages that say anything a thousand times a second, and another one's STOP meanwhile."""

import os
import threading
import time
from pathlib import Path

import pytest

from tests.support.console.flood import Flood
from tests.support.console.server import serving

WITHIN_S = 0.5


def status(pid: int, what: str) -> int:
    """Threads, or VmRSS in kB, of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(what)))


@pytest.mark.parametrize(
    ("seconds", "least_rate"),
    # Other tests take most of the processor beside the short one: what it says then would still deny a STOP without
    # the one slot for all of them.
    [(2.0, 200.0), pytest.param(60.0, 1000.0, marks=pytest.mark.campaign)],
)
def test_a_stop_is_carried_out_in_a_flood(tmp_path, seconds: float, least_rate: float):
    """Pressed three times a second during a flood; each is carried out, and begun, in time."""
    with serving(tmp_path) as server:
        server.stop_s = 0.1
        with Flood(server) as flood:
            cookie, key = server.enter()
            time.sleep(1.0)
            pids = {"Threads": (server.process._process.pid, os.getpid()), "VmRSS": (server.process._process.pid,)}
            before = {what: [status(pid, what) for pid in of] for what, of in pids.items()}
            late, end = [], time.monotonic() + seconds
            while time.monotonic() < end:
                pressed = time.monotonic()
                assert server.ask("POST", "/api/do", '{"do": "stop"}', cookie=cookie, x_cell_key=key).status == 200
                late.append(next(begun for begun in server.begun if begun >= pressed) - pressed)
                time.sleep(0.23)
            after = {what: [status(pid, what) for pid in of] for what, of in pids.items()}
    assert flood.rate > least_rate
    assert max(late) < WITHIN_S
    assert max(after["Threads"]) <= max(before["Threads"]) + 8
    assert after["VmRSS"][0] - before["VmRSS"][0] < 20_000


def test_stops_at_once_have_one_stop_in_common(tmp_path):
    """One is under way, all others wait for the next one; each is answered."""
    with serving(tmp_path) as server:
        server.stop_s = 0.3
        _ = server.cookie
        answers: list[int] = []
        threads = [threading.Thread(target=lambda: answers.append(server.do(do="stop").status)) for _ in range(30)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(20)
        assert answers == [200] * 30
        assert 1 <= server.stops <= 6
        with server.live() as page:
            before = server.stops
            for _ in range(40):
                page.send('{"type": "stop"}')
            assert server.do(do="stop").status == 200
            assert before < server.stops <= before + 4


def test_a_stop_that_a_device_does_not_confirm_holds_up_no_other(tmp_path):
    with serving(tmp_path) as server:
        server.stop_s = 1.5
        _ = server.cookie
        presses = [threading.Thread(target=lambda: server.do(do="stop")) for _ in range(2)]
        presses[0].start()
        time.sleep(0.5)
        pressed = time.monotonic()
        presses[1].start()
        time.sleep(WITHIN_S)
        assert any(begun >= pressed for begun in server.begun)
        for press in presses:
            press.join(20)
