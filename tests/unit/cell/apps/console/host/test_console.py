"""The console of a cell, its server and a page together: STOP before all; and where it listens."""

import json
import os
import signal
import threading
import time
from typing import Any

import pytest

from cell.apps.cli.commands.console import shown
from cell.apps.console.host.console import Address, Console
from cell.apps.console.host.link import ServerProcess
from cell.run.runs import Run
from cell.run.session.supervisor import Cell
from drivers.errors import ConfigError
from statemachine.step import Failure, Outcome
from tests.support import until
from tests.support.console.server import Browser


def state(page: Any, true: Any) -> dict[str, Any]:
    """The next state that is so."""
    while True:
        said = page.recv(timeout=20)
        if isinstance(said, str) and (told := json.loads(said))["type"] == "state" and true(told):
            return told


def test_a_page_sees_holds_and_stops_and_another_one_takes_over(cell: Cell, console: Console):
    ann = Browser(console.link)
    assert ann.ask("GET", "/api/cell").words["name"] == cell.config.cell.name
    assert ann.ask("GET", "/api/cell?job=seat").words["job"] == "seat"
    assert ann.ask("GET", "/api/cell?job=none").status == 400
    before = console.link
    with ann.live() as first, ann.live() as second:
        key, other = (json.loads(page.recv(timeout=20))["key"] for page in (first, second))
        assert ann.do(do="hold", name="Ann", key=key).words["text"] == "Ann holds the cell"
        assert ann.do(do="manual", on=True, key=other).status == 403
        assert ann.do(do="manual", on=True, key=key).status == 200
        assert ann.do(do="start", job="pot", key=key).status == 409
        told = state(first, lambda told: told["manual"])
        assert (told["run"]["kind"], [row["name"] for row in told["clients"]]) == ("jog", ["Ann", ""])
        # The one that does not hold stops it.
        stops = cell.stops
        second.send('{"type": "stop"}')
        assert until(lambda: cell.stops == stops + 1)
        told = state(first, lambda told: not told["manual"] and told["last"])
        assert told["safety"]["stopped"]
        assert told["last"]["outcome"] == "aborted"
        assert ann.do(do="hand_over", to=told["clients"][1]["id"], key=key).status == 200
        assert ann.do(do="clear_stop", by="Bob", key=other).status == 200
        state(second, lambda seen: not seen["safety"]["stopped"] and seen["holder"] == told["clients"][1]["id"])
    assert until(lambda: not console.seen)
    assert console.link == before


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.7", "::", "localhost"])
def test_another_address_needs_a_token_and_tls(tmp_path, host: str):
    token = tmp_path / "token"
    token.write_text("x" * 40)
    token.chmod(0o600)
    for address in (Address(host), Address(host, token_file=token), Address(host, certificate=token, key=token)):
        with pytest.raises(ConfigError):
            address.checked()


@pytest.mark.parametrize(("text", "mode"), [("short", 0o600), ("x" * 40, 0o644), ("", 0o600), ("x y" * 20, 0o600)])
def test_a_token_that_others_know_or_guess_is_refused_and_not_shown(tmp_path, text: str, mode: int):
    token = tmp_path / "token"
    token.write_text(text)
    token.chmod(mode)
    with pytest.raises(ConfigError) as refused:
        Address(token_file=token).checked()
    assert not text or text not in str(refused.value)


def test_a_question_about_a_job_that_a_command_began_ends_with_it(cell: Cell, console: Console):
    run, made = cell.begin("jog", lambda run: until(lambda: run.control.token.reason is not None)), list[object]()
    decide = console.script("pot").on_refusal
    with Browser(console.link).live():
        assert until(lambda: console.seen)
        failure = Failure(Outcome.REFUSED, "no board")
        asked = threading.Thread(target=lambda: made.append(decide("board_photo", failure)), daemon=True)
        asked.start()
        assert until(lambda: console.controller.questions.present(None) is not None)
        run.abort("interrupted")
        asked.join(5)
    assert made == [None]
    run.ended(10)


def test_ctrl_c_stops_the_cell_before_its_server_is_waited_for(cell: Cell, monkeypatch):
    """A server that hangs is what makes somebody turn to Ctrl-C."""
    ended: list[str | None] = []
    close = ServerProcess.close

    def waits(run: Run[None]) -> None:
        while run.control.token.reason is None:
            time.sleep(0.01)

    monkeypatch.setattr(ServerProcess, "close", lambda server: (ended.append(run.control.token.reason), close(server)))
    run = cell.begin("check", waits, None, cell.stops)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    assert shown(cell, "pot", Address(), open_page=False) == 130
    run.abort()
    assert ended == ["stopped with Cell.stop()"]
    cell.clear_stop("the test")
