"""`cell jog` and `cell watch` at a served cell: what a terminal stops, and how soon, by what the simulated world says;
and what is seen of a cell that another process runs."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from cell.config import load_config
from cell.devices.truth_link import ask_truth
from cell.terminal.watch import watching
from drivers.clock import Clock
from tests.wire.cells import command, served, started

pytestmark = pytest.mark.wire

WITHIN_S = 0.25
J1 = [b"\x1b[B"] * 7
"""From the rail, which is chosen first, down to joint 1."""
PRESS, RELEASE = b"\x1b[1;1:1C", b"\x1b[1;1:3C"


class Terminal:
    """A terminal of the kitty protocol at the other end of a pty; `answers` False is one that is lost or frozen."""

    def __init__(self, folder: Path, releases: bool = True) -> None:
        self.master, child = pty.openpty()
        termios.tcsetwinsize(self.master, (24, 80))
        self.answers = True
        self.shown = ""
        self._flags = 0 if releases else None
        self.process = subprocess.Popen(
            command("jog", "-c", str(folder / "sim.toml")), cwd=folder, stdin=child, stdout=child,
            stderr=subprocess.PIPE, start_new_session=True, process_group=None,
            preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)),
        )  # fmt: skip
        os.close(child)
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while data := os.read(self.master, 65536):
                self.shown += data.decode(errors="replace")
                if not self.answers:
                    continue
                for asked in re.findall(rb"\x1b\[5n|\x1b\[\?u|\x1b\[>11u", data):
                    if asked == b"\x1b[5n":
                        os.write(self.master, b"\x1b[0n")
                    elif self._flags is not None and asked == b"\x1b[>11u":
                        self._flags = 11
                    elif self._flags is not None:
                        os.write(self.master, b"\x1b[?%du" % self._flags)

    def say(self, *keys: bytes) -> None:
        for key in keys:
            os.write(self.master, key)
            Clock().sleep(0.03)

    def wait_for(self, text: str, timeout: float = 40.0) -> None:
        until(lambda: text in self.shown, timeout, f"{text!r} in {self.shown[-2000:]!r}")


def until(true: Callable[[], bool], timeout: float, what: str) -> None:
    end = time.monotonic() + timeout
    while not true():
        assert time.monotonic() < end, f"did not come: {what}"
        Clock().sleep(0.02)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    folder = tmp_path_factory.mktemp("cell")
    with served(folder, "--speed", "1") as endpoints:
        yield folder, endpoints["truth"]["address"]


@pytest.fixture
def terminal(cell: tuple[Path, str]) -> Iterator[Terminal]:
    made = Terminal(cell[0])
    made.wait_for("safety normal")
    yield made
    if made.process.poll() is None:
        made.process.kill()
    made.process.communicate()
    with suppress(OSError):
        os.close(made.master)


def moving(truth: str) -> bool:
    return bool(ask_truth(truth)["arm"]["moving"])


def stood_after(truth: str, since: float) -> float:
    """Wall seconds from `since` until the arm stands, and goes on standing."""
    stood = None
    while time.monotonic() < since + 1.0:
        now = time.monotonic() - since
        if moving(truth):
            stood = None
        elif stood is None:
            stood = now
        Clock().sleep(0.005)
    assert stood is not None
    return stood


def end_of(terminal: Terminal, how: str) -> float:
    """Let the key, the link, the terminal or the program go; when that was."""
    since = time.monotonic()
    match how:
        case "released":
            os.write(terminal.master, RELEASE)
        case "lost link":
            terminal.answers = False
        case "terminal killed":
            os.close(terminal.master)
        case "hung program":
            terminal.process.send_signal(signal.SIGSTOP)
        case "killed program":
            terminal.process.kill()
    return since


def held(truth: str, terminal: Terminal) -> None:
    """Hold the key for joint 1 until it moves, and a little longer than anything tolerates silence.

    On a busy machine a beat may be late, which ends a press before it moves anything: a person presses again.
    """
    until(lambda: not moving(truth), 5.0, "rest")
    for left in (2, 1, 0):
        terminal.say(PRESS)
        try:
            until(lambda: moving(truth), 3.0, "motion")
        except AssertionError:
            terminal.say(RELEASE)
            if left == 0:
                raise
        else:
            break
    Clock().sleep(0.3)
    assert moving(truth)


def test_a_held_key_moves_until_nobody_holds_it(cell: tuple[Path, str], terminal: Terminal) -> None:
    truth = cell[1]
    terminal.say(*J1)
    for how in ("released", "lost link", "terminal killed"):
        held(truth, terminal)
        took = stood_after(truth, end_of(terminal, how))
        print(f"{how}: stands after {1e3 * took:.0f} ms")
        assert took < WITHIN_S, how
        if how == "lost link":
            # What comes late begins nothing, and the next press needs a terminal that answers.
            terminal.answers = True
            os.write(terminal.master, b"\x1b[0n")
            Clock().sleep(0.2)
            assert not moving(truth)
            terminal.say(RELEASE)
    # It has ended by itself, through the safe stop, and left the cell to the next one.
    terminal.process.wait(20)


@pytest.mark.campaign
def test_a_cell_that_another_process_runs_is_watched(cell: tuple[Path, str]) -> None:
    folder = cell[0]
    config = load_config(folder / "sim.toml")
    with started("home", "-c", str(folder / "sim.toml"), folder=folder) as home:
        with watching(config, folder / config.cell.runs, whole=False) as watch:
            seen: list[str] = []
            until(lambda: seen.append("\n".join(watch.lines())) or "homing" in seen[-1], 90.0, "the run")
            until(lambda: seen.append("\n".join(watch.lines())) or home.poll() is not None, 90.0, "its end")
            assert home.poll() == 0, home.communicate()[1]
            until(lambda: seen.append("\n".join(watch.lines())) or "nothing goes on" in seen[-1], 10.0, "rest")
            until(lambda: seen.append("\n".join(watch.lines())) or "  deg" in seen[-1], 10.0, "the arm")
            last = seen[-1]
        joints = [float(value) for value in re.findall(r"  deg +(.*)", last)[0].split()]
        assert joints == pytest.approx([90.0, -100.0, 100.0, -90.0, -90.0, 0.0], abs=0.02)
        # It was seen on its way, beside its limits, and the rail was left to its only user.
        assert len({re.findall(r"  deg +(.*)", text)[0] for text in seen if "  deg" in text}) > 3
        assert any("safety normal, moves" in text for text in seen)
        assert any("rail     not looked at, its line has one user: process" in text for text in seen)
        assert "nothing goes on" in last
    with watching(config, folder / config.cell.runs, whole=True) as watch:
        until(lambda: "rail     homed, stands at 0.000 mm" in "\n".join(watch.lines()), 10.0, "the rail")


@pytest.mark.campaign
@pytest.mark.parametrize("how", ["hung program", "killed program"])
def test_a_held_key_does_not_outlive_the_program(cell: tuple[Path, str], terminal: Terminal, how: str) -> None:
    terminal.say(*J1)
    held(cell[1], terminal)
    took = stood_after(cell[1], end_of(terminal, how))
    print(f"{how}: stands after {1e3 * took:.0f} ms")
    assert took < WITHIN_S


@pytest.mark.campaign
def test_a_terminal_that_reports_no_release_is_offered_steps_only(cell: tuple[Path, str]) -> None:
    terminal = Terminal(cell[0], releases=False)
    try:
        terminal.wait_for("steps only")
        terminal.wait_for("safety normal")
        terminal.say(*[b"\x1b[B"] * 7, b"]", b"]", b"]", b"\x1b[C")
        until(lambda: re.search(r"j1 -?[0-9]+[.][0-9]{3} deg", terminal.shown) is not None, 40.0, "the end of a step")
        until(lambda: not moving(cell[1]), 5.0, "rest")
        # A step that is under way ends when it is told to, and when the terminal goes.
        terminal.say(b"\x1b[C")
        until(lambda: moving(cell[1]), 10.0, "motion")
        assert stood_after(cell[1], end_of(terminal, "terminal killed")) < 2 * WITHIN_S
        terminal.process.wait(20)
    finally:
        if terminal.process.poll() is None:
            terminal.process.kill()
        terminal.process.communicate()
