"""The processes of a console: when one of them ends, in whatever way, nothing is left behind and the cell stands."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.browser.screen import Console as Going
from tests.support.browser.screen import console_of
from tests.support.console.server import Browser, running, until


def below(root: int) -> dict[int, str]:
    """All processes that `root` has begun, and those that they have, with their arguments."""
    parents, found = {}, {root}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    while more := {pid for pid, parent in parents.items() if parent in found} - found:
        found |= more
    return {pid: Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ") for pid in found - {root}}


@pytest.fixture
def going(tmp_path: Path) -> Iterator[Going]:
    with console_of(tmp_path) as console:
        yield console


@pytest.mark.wire
def test_a_console_whose_server_is_killed_stops_and_ends(going: Going) -> None:
    browser = Browser(going.link())
    assert browser.token not in " ".join(below(going.process.pid).values())
    left = below(going.process.pid)
    (server,) = (pid for pid, words in left.items() if "cell.apps.console.server.serve" in words)
    begun = time.monotonic()
    os.kill(server, signal.SIGKILL)
    assert going.process.wait(20.0) == 1
    print(f"ended {time.monotonic() - begun:.1f} s after its server")
    assert until(lambda: not any(running(pid) for pid in left), 5.0)


@pytest.mark.wire
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=["interrupted", "killed"])
def test_a_console_that_ends_takes_its_dry_run_along(going: Going, number: signal.Signals) -> None:
    browser = Browser(going.link())
    with browser.live() as page:
        key = json.loads(page.recv(timeout=20))["key"]
        assert browser.do(do="hold", name="Ann", key=key).status == 200
        assert browser.do(do="dry_run", job="pot", key=key).status == 200
        assert until(lambda: any("rehearsal" in words for words in below(going.process.pid).values()))
        left = below(going.process.pid)
        going.process.send_signal(number)
        going.process.wait(20.0)
        assert until(lambda: not any(running(pid) for pid in left), 5.0), {
            pid: words for pid, words in left.items() if running(pid)
        }
