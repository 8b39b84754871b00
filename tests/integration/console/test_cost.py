"""What the server costs: the processor's time of its process, user and system, against the wall's."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cell.apps.console.host.link import CloudPart, Show, ShownPicture
from tests.support.console.server import Served, serving

pytestmark = pytest.mark.campaign

ALLOWED = 0.05
SECONDS, PERIOD_S = 12.0, 0.05
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
sys.stdin.read()"""
"""A program of its own that looks as so many pages do. Its input, which nobody else sees as they do its arguments, is
a line of JSON: host, cookie, key, count."""


@pytest.mark.parametrize("pages", [1, 5])
def test_states_pictures_and_cloud_take_at_most_a_twentieth_of_a_core(tmp_path, pages: int):
    noise = np.random.default_rng(0).normal(60.0, 4.0, (480, 640)).clip(0, 255).astype(np.uint8)
    noise[:, 300:306] = 220
    with serving(tmp_path) as server:
        client = looking(server.host, server.cookie, server.key, pages)
        try:
            time.sleep(3.0)
            before, begun = cpu(server.process.pid), time.monotonic()
            show(server, noise)
            share = (cpu(server.process.pid) - before) / (time.monotonic() - begun)
        finally:
            client.kill()
            client.communicate()
    print(f"{pages} pages: {100 * share:.1f} % of a core")
    assert share < ALLOWED


def show(server: Served, picture: np.ndarray) -> None:
    """Twenty states, ten pictures and ten increments of the cloud a second."""
    begun = time.monotonic()
    for n in range(round(SECONDS / PERIOD_S)):
        server.process.notify(Show(json.dumps({"type": "state", "n": n, "fill": "x" * 3000})))
        if n % 2 == 0:
            server.process.notify(ShownPicture({"type": "picture", "camera": "scan_camera"}, np.roll(picture, n, 1)))
            server.process.notify(CloudPart({"type": "cloud", "reset": n % 100 == 0}, b"\0" * 6400))
        time.sleep(max(0.0, begun + (n + 1) * PERIOD_S - time.monotonic()))


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
