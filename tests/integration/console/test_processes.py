"""The processes of a console: when one of them ends, in whatever way, nothing is left behind and the cell stands."""

import json
import os
import signal
import threading
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
import typer

from cell import Cell
from cell.apps.cli.commands.console import console
from lab.bench.wires.soak import descendants
from tests.support import running, until
from tests.support.browser.screen import console_of
from tests.support.console.server import Browser


def told(root: int) -> dict[int, str]:
    """The processes below `root` with their arguments."""
    return {pid: Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ") for pid in descendants(root)}


def ended(link: str, program: int, end: Callable[[int], None]) -> dict[int, str]:
    """Begin a dry run by a page of the console of this `program`, and `end` it, given its server: what went on then."""
    browser = Browser(link)
    with browser.live() as page:
        key = json.loads(page.recv(timeout=20))["key"]
        assert browser.do(do="hold", name="Ann", key=key).status == 200
        assert browser.do(do="dry_run", job="pot", key=key).status == 200
        assert until(lambda: any("rehearsal" in words for words in told(program).values()))
        left = told(program)
        assert browser.token not in " ".join(left.values())
        (server,) = (pid for pid, words in left.items() if "cell.apps.console.server.serve" in words)
        end(server)
    return left


def gone(left: dict[int, str]) -> bool:
    return until(lambda: not any(running(pid) for pid in left), 5.0)


@pytest.mark.wire
def test_a_console_that_is_killed_takes_its_server_its_dry_run_and_its_cell_along(tmp_path: Path) -> None:
    with console_of(tmp_path) as going:
        left = ended(going.link(), going.process.pid, lambda server: going.process.kill())
        going.process.wait(20.0)
        assert gone(left), {pid: words for pid, words in left.items() if running(pid)}


@pytest.mark.parametrize(("whom", "number", "code"), [("console", signal.SIGINT, 0), ("server", signal.SIGKILL, 1)])
def test_a_console_ends_with_a_signal_or_its_server_and_takes_its_dry_run_along(
    here: Path, monkeypatch: pytest.MonkeyPatch, whom: str, number: signal.Signals, code: int
) -> None:
    """In this process and before a cell of the virtual clock."""
    links, left = list[str](), dict[int, str]()

    def page() -> None:
        assert until(lambda: links, 20.0)
        me = os.getpid()
        left.update(ended(links[0], me, lambda server: os.kill(server if whom == "server" else me, number)))

    with Cell.open(sim="all", seed=3, clock="virtual") as cell:
        monkeypatch.setattr(Cell, "open", lambda *_, **__: nullcontext(cell))
        monkeypatch.setattr("cell.apps.cli.commands.console.page_notifier", lambda open_page: links.append)
        person = threading.Thread(target=page)
        person.start()
        with pytest.raises(typer.Exit) as told_by:
            console(sim="all")
        person.join(20.0)
        assert (told_by.value.exit_code, cell.devices.gate.is_open) == (code, code == 0)
    assert left and gone(left)
