"""The processes of a console: when one of them ends, in whatever way, nothing is left behind and the cell stands."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.apps.console.host.console import Console
from cell.apps.console.host.rehearsal import Rehearsals
from cell.apps.console.messages import Beat
from cell.run.session.supervisor import Cell
from drivers.errors import InterlockError
from tests.support.browser.screen import Console as Going
from tests.support.browser.screen import console_of
from tests.support.console.server import Browser, until


def running(pid: int) -> bool:
    """Whether a process lives, and is no corpse that nobody has looked at."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


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


def test_a_dry_run_tells_how_far_it_is_and_can_be_cancelled(cell: Cell) -> None:
    rehearsals = Rehearsals(cell)
    with pytest.raises(InterlockError):
        rehearsals.cancel()
    rehearsals.begin("pot", 3)
    assert until(lambda: (rehearsals.present or {}).get("text") == "simulating the cell", 60.0)
    process = rehearsals._process
    assert process is not None
    rehearsals.cancel()
    assert until(lambda: rehearsals.present is not None and rehearsals.present["state"] == "done")
    assert rehearsals.present["outcome"] == "cancelled"
    assert not running(process.pid)


def test_a_dry_run_ends_with_its_input(tmp_path: Path) -> None:
    """The console holds the other end, which closes with it."""
    command = [sys.executable, "-m", "cell.apps.console.host.rehearsal", "pot", "3", "nominal", ""]
    process = subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdin is not None
    assert b"loading" in process.stdout.readline()
    process.stdin.close()
    assert process.wait(20.0) == 1
    process.stdout.close()


@pytest.mark.parametrize("hung", ["beat", "joined"])
def test_a_killed_server_is_noticed_whatever_the_other_threads_do(
    cell: Cell, hung: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that hears the server hangs in a message; another message is none that it could take."""
    gone, held = threading.Event(), threading.Event()
    with Console(cell, "pot", gone=gone.set) as console:
        console._heard(Beat("c1", {"type": "jog", "press": 1, "at": 10**400}))
        monkeypatch.setattr(console.desk, hung, lambda *_: held.wait(60))
        browser = Browser(console.link)
        with browser.live() as page:
            page.send(json.dumps({"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1}))
            os.kill(console.server_pid, signal.SIGKILL)
            assert gone.wait(2.0)
        held.set()


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
