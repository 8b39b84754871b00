"""The processes of a console: when one of them ends, in whatever way, nothing is left behind and the cell stands."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from lab.bench.wires.soak import descendants
from tests.support import running, until
from tests.support.browser.screen import Console as Going
from tests.support.browser.screen import console_of
from tests.support.console.server import Browser


def told(root: int) -> dict[int, str]:
    """The processes below `root` with their arguments."""
    return {pid: Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ") for pid in descendants(root)}


@pytest.fixture
def going(tmp_path) -> Iterator[Going]:
    with console_of(tmp_path) as console:
        yield console


@pytest.mark.wire
@pytest.mark.parametrize(("whom", "number", "code"), [
    ("console", signal.SIGINT, 0), ("console", signal.SIGKILL, -signal.SIGKILL), ("server", signal.SIGKILL, 1),
])  # fmt: skip
def test_a_console_that_ends_takes_its_server_and_its_dry_run_along(
    going: Going, whom: str, number: signal.Signals, code: int
):
    browser = Browser(going.link())
    with browser.live() as page:
        key = json.loads(page.recv(timeout=20))["key"]
        assert browser.do(do="hold", name="Ann", key=key).status == 200
        assert browser.do(do="dry_run", job="pot", key=key).status == 200
        assert until(lambda: any("rehearsal" in words for words in told(going.process.pid).values()))
        left = told(going.process.pid)
        assert browser.token not in " ".join(left.values())
        (server,) = (pid for pid, words in left.items() if "cell.apps.console.server.serve" in words)
        os.kill(server if whom == "server" else going.process.pid, number)
        assert going.process.wait(20.0) == code
        assert until(lambda: not any(running(pid) for pid in left), 5.0), {
            pid: words for pid, words in left.items() if running(pid)
        }
