"""Whether pages that look cost the cell anything: its streams to the arm and from the camera without and with them.

Each page is read by a client of others, in a process of its own: all that the server sends, twenty states and ten
pictures a second. A bare loop beside it shows what this machine lets anybody do at that time.
"""

from __future__ import annotations

import http.client
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from cell.apps.console.host.console import Console
from cell.procedures.frame_store import FrameStore
from cell.run.runs import Run
from cell.run.session.supervisor import Cell
from drivers.errors import CellError, DeadlineError
from lab.bench.wires.servo import streamed

PAGES = 5
FRAME_RATE_HZ, EXPOSURE_S = 50.0, 1e-3
START_S = 20.0
TICKS = os.sysconf("SC_CLK_TCK")

READING = """
import json, sys, threading
from websockets.sync.client import connect
host, cookie, key, count = json.loads(sys.stdin.readline())
def look():
    with connect(f"ws://{host}/live", additional_headers={"cookie": cookie}, origin=f"http://{host}",
                 subprotocols=["cell", key], max_size=None, compression=None) as page:
        for _ in page:
            pass
for _ in range(count):
    threading.Thread(target=look, daemon=True).start()
sys.stdin.read()
"""
"""A program of its own that looks as so many pages do. Its input, which nobody else sees as they do its arguments, is
a line of JSON: host, cookie, key, count."""


def measure(seconds: float, rounds: int, seed: int, progress: Callable[[float, str], None]) -> dict[str, Any]:
    """`rounds` times: `seconds` on the wall without a console, with one, and with one at which five pages look."""
    rows = []
    kinds = (("no console", None), ("console, no page", 0), (f"console, {PAGES} pages", PAGES))
    with tempfile.TemporaryDirectory() as folder, Cell.open(sim="all", seed=seed, speed=1.0) as cell:
        cell.devices.scan_camera.configure(EXPOSURE_S, FRAME_RATE_HZ)
        for k in range(rounds * len(kinds)):
            what, pages = kinds[k % len(kinds)]
            progress(k / (rounds * len(kinds)), what)
            rows.append(_row(cell, seconds, what, pages, Path(folder)))
    return {"seconds": seconds, "rounds": rounds, "cores": os.cpu_count(), "rows": rows}


def _row(cell: Cell, seconds: float, what: str, pages: int | None, folder: Path) -> dict[str, Any]:
    with nullcontext() if pages is None else Console(cell) as console, _looking(console, pages or 0):
        with _shown(cell, folder) as frames:
            before = None if console is None else cpu(console.server_pid)
            begun = time.monotonic()
            row = streamed(cell, seconds, [], 1, what)
            took = time.monotonic() - begun
            share = None if console is None or before is None else (cpu(console.server_pid) - before) / took
        return {**row, "load": round(os.getloadavg()[0], 1), "frames": frames[0], "lost": frames[1], "server": share}


@contextmanager
def _shown(cell: Cell, folder: Path) -> Iterator[list[int]]:
    """Inside this context the camera streams, as in a run that keeps its frames; how many came, and were lost."""
    counted, over = [0, 0], threading.Event()

    def look(run: Run[None]) -> None:
        run.frames = FrameStore(folder)
        with cell.devices.scan_camera.stream() as stream:
            while not over.is_set():
                try:
                    # The newest only: what is measured is not the disk.
                    run.frames.last = "stripe", stream.next(1.0)
                    counted[0] += 1
                except DeadlineError:
                    continue
            counted[1] = stream.lost

    run = cell.begin("calibration", look)
    try:
        yield counted
    finally:
        over.set()
        run.ended(START_S)


@contextmanager
def _looking(console: Console | None, pages: int) -> Iterator[None]:
    """Inside this context so many pages look."""
    if console is None or not pages:
        yield
        return
    host, link = console.link.split("/", 3)[2:]
    asked = http.client.HTTPConnection(host, timeout=START_S)
    asked.request("GET", f"/{link}")
    answer = asked.getresponse()
    cookie = answer.headers["set-cookie"].partition(";")[0]
    key = answer.read().decode().partition("#key=")[2].partition('"')[0]
    asked.close()
    client = looking(host, cookie, key, pages)
    try:
        end = time.monotonic() + START_S
        while len(console.desk.holders.rows()) < pages:
            if time.monotonic() > end:
                raise CellError(f"{pages} pages were not open within {START_S:.0f} s")
            time.sleep(0.05)
        yield
    finally:
        client.kill()
        client.communicate()


def looking(host: str, cookie: str, key: str, pages: int) -> subprocess.Popen[bytes]:
    """So many pages in a process of their own, which is to be killed."""
    client = subprocess.Popen([sys.executable, "-c", READING], stdin=subprocess.PIPE)
    assert client.stdin is not None
    client.stdin.write(json.dumps([host, cookie, key, pages]).encode() + b"\n")
    client.stdin.flush()
    return client


def cpu(pid: int) -> float:
    """Seconds of a core that the process has had, user and system."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / TICKS
