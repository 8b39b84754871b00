"""A held button: what begins a motion, what goes on with it, and what ends it."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

from cell.apps.console.host.controller import ConsoleController
from cell.apps.console.host.manual import LATE_S, Presses
from cell.run.jogging import Jog
from cell.run.session.supervisor import Cell
from drivers.errors import Aborted, InterlockError
from drivers.interfaces import ATTENDED_S
from tests.support import until

Z_UP = ("arm", "z", 1)


def test_a_press_lives_by_its_beats_and_never_twice():
    presses, beaten = Presses(), []
    press = presses.beat("c1", 7, *Z_UP)
    press.beat = lambda: beaten.append(time.monotonic())
    assert presses.beat("c1", 7, *Z_UP) is None
    assert len(beaten) == 1
    assert press.over() is None
    time.sleep(1.2 * ATTENDED_S)
    # What comes after the silence, all at once as after a pause of the line, moves nothing any more.
    assert [presses.beat("c1", 7, *Z_UP) for _ in range(5)] == [None] * 5
    assert len(beaten) == 1
    assert "no beat came" in str(press.over())
    assert presses.beat("c1", 6, *Z_UP) is None and presses.beat("c1", 8, *Z_UP) is not None


def test_release_and_a_second_button_end_it():
    presses = Presses()
    first = presses.beat("c1", 1, *Z_UP)
    presses.end("c1", "the button was let go of")
    assert first.over() == "the button was let go of"
    assert presses.beat("c1", 1, *Z_UP) is None

    second = presses.beat("c1", 2, *Z_UP)
    # Neither another axis, nor the other way, nor another press of the same button goes on with it or begins anything.
    assert presses.beat("c1", 3, "arm", "x", 1) is None
    assert second.over() is not None
    assert presses.beat("c1", 3, "arm", "x", 1) is None
    third = presses.beat("c1", 4, *Z_UP)
    assert presses.beat("c1", 4, "arm", "z", -1) is None
    assert third.over() is not None


def test_another_page_ends_what_a_page_holds_and_begins_nothing():
    presses = Presses()
    press = presses.beat("c1", 1, *Z_UP)
    assert presses.beat("c2", 1, *Z_UP) is None
    assert press.over() is not None
    presses.left("c1")
    other = presses.beat("c3", 1, *Z_UP)
    assert other is not None and other.over() is None
    presses.left("c3")
    assert other.over() == "the page is gone"


def test_a_beat_that_was_long_under_way_begins_nothing():
    """The line stood still with a whole press in it: what comes out of it is old, by the page's own clock."""
    presses = Presses()
    at = 1e3 * time.monotonic()
    assert presses.beat("c1", 1, *Z_UP, at_ms=at) is not None
    presses.end("c1", "up")
    assert presses.beat("c1", 2, *Z_UP, at_ms=at - 1e3 * (LATE_S + 0.05)) is None
    assert presses.beat("c1", 3, *Z_UP, at_ms=at) is not None


def test_a_press_ends_when_the_watch_beside_the_device_is_lost():
    def lost() -> None:
        raise InterlockError("rail", "the helper is gone")

    presses = Presses()
    press = presses.beat("c1", 1, "rail", "", 1)
    press.beat = lost
    presses.beat("c1", 1, "rail", "", 1)
    assert "the helper is gone" in str(press.over())


def test_who_waits_for_the_end_hears_it_at_once():
    presses = Presses()
    press = presses.beat("c1", 1, *Z_UP)
    threading.Timer(0.02, lambda: presses.end_all("stopped")).start()
    begun = time.monotonic()
    press.wait(5.0)
    assert time.monotonic() - begun < 1.0
    assert press.over() == "stopped"


@pytest.mark.parametrize(("device", "axis"), [("arm", "z"), ("arm", "j1"), ("rail", "")])
@pytest.mark.parametrize("end", ["release", "page gone", "another button", "manual off", "silence"])
def test_what_ends_a_held_button_stops_the_motion(
    cell: Cell, controller: ConsoleController, monkeypatch, device: str, axis: str, end: str
):
    """Virtual time passes here alone: what moves on after the end would be seen to."""
    cell.home("rail")
    told: list[str] = []
    moved: Any = getattr(cell.devices, device)
    monkeypatch.setattr(moved.bare, "attended", lambda: nullcontext(lambda: None), raising=False)
    monkeypatch.setattr("cell.apps.console.host.manual.ATTENDED_S", 60.0)
    monkeypatch.setattr(controller, "_say", lambda client, words: told.append(words["state"]))
    controller.do("c1", {"do": "hold", "name": "Ann"})
    controller.do("c1", {"do": "manual", "on": True})

    def beat(number: int) -> None:
        controller.beat("c1", {"type": "jog", "press": number, "device": device, "axis": axis, "sign": 1, "at": None})

    def place() -> Any:
        return moved.state().position if device == "rail" else moved.state().joints

    begun = place()
    beat(1)
    assert until(lambda: told == ["moving"])
    cell.devices.clock.sleep(0.3)
    assert np.abs(place() - begun).max() > 1e-4
    ends: dict[str, Any] = {
        "release": lambda: controller.jog_end("c1"), "page gone": lambda: controller.left("c1"),
        "another button": lambda: beat(2), "manual off": lambda: controller.do("c1", {"do": "manual", "on": False}),
        "silence": lambda: monkeypatch.setattr("cell.apps.console.host.manual.ATTENDED_S", 0.0),
    }  # fmt: skip
    ends[end]()
    assert until(lambda: told == ["moving", "ended"])
    stood = place()
    cell.devices.clock.sleep(0.5)
    assert np.abs(place() - stood).max() < 1e-5
    beat(1)
    cell.devices.clock.sleep(0.5)
    assert np.abs(place() - stood).max() < 1e-5


def test_a_clock_of_the_page_that_goes_slow_makes_no_beat_late(monkeypatch):
    """60 ppm are .43 s after two hours. A line that is slow at once is told from that."""
    presses, now = Presses(), time.monotonic()
    for number in range(1, 120):
        monkeypatch.setattr(time, "monotonic", lambda number=number: now + 60.0 * number)
        assert presses.beat("c1", number, *Z_UP, at_ms=1e3 * (now + 60.0 * number * (1 - 60e-6))) is not None, number
        presses.end("c1", "up")
    assert presses.beat("c1", 200, *Z_UP, at_ms=1e3 * (now + 60.0 * 119 * (1 - 60e-6) - LATE_S - 0.05)) is None


@pytest.mark.parametrize("end", ["manual off", "page gone"])
def test_what_ends_manual_mode_stops_a_step_on_its_way(cell: Cell, controller: ConsoleController, end: str):
    controller.do("c1", {"do": "hold", "name": "Ann"})
    controller.do("c1", {"do": "manual", "on": True})
    before = cell.devices.arm.state().flange[2]
    with ThreadPoolExecutor() as beside:
        step = beside.submit(controller.manual.step, Jog("arm", "z", 0.25))
        assert until(lambda: cell.devices.arm.state().flange[2] > before + 1e-3)
        controller.left("c1") if end == "page gone" else controller.do("c1", {"do": "manual", "on": False})
        assert isinstance(step.exception(20.0), Aborted)
    assert until(lambda: cell.current is None)
    stood = cell.devices.arm.state().flange[2]
    cell.devices.clock.sleep(1.0)
    assert cell.devices.arm.state().flange[2] == pytest.approx(stood, abs=1e-5) and stood < before + 0.2
