"""What the server costs: the processor's time of its process, user and system, against the wall's."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from cell.apps.console.messages import CloudPart, Show, ShownPicture
from lab.bench.wires.pages import cpu, looking
from tests.support.console.server import Served, serving

pytestmark = pytest.mark.campaign

ALLOWED = 0.05
SECONDS, PERIOD_S = 12.0, 0.05


@pytest.mark.parametrize("pages", [1, 5])
def test_states_pictures_and_cloud_take_at_most_a_twentieth_of_a_core(tmp_path: Path, pages: int) -> None:
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
        server.process.tell(Show(json.dumps({"type": "state", "n": n, "fill": "x" * 3000})))
        if n % 2 == 0:
            server.process.tell(ShownPicture({"type": "picture", "camera": "scan_camera"}, np.roll(picture, n, 1)))
            server.process.tell(CloudPart({"type": "cloud", "reset": n % 100 == 0}, b"\0" * 6400))
        time.sleep(max(0.0, begun + (n + 1) * PERIOD_S - time.monotonic()))
