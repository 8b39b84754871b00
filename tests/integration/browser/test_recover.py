"""Out of a fault by the screen: a homing that was stopped is asked about, an idle arm is unlocked by a button."""

from typing import Any

import pytest

from tests.support.browser.pressing import idle
from tests.support.browser.screen import Console, Screen
from tests.support.browser.watcher import Watcher
from tests.support.wire.cells import ask, served, started

pytestmark = pytest.mark.wire


def test_a_person_unlocks_an_idle_arm_and_answers_for_a_homing(browser: Any, tmp_path):
    with served(tmp_path, "--seed", "3", "--level", "ideal") as endpoints:
        (tmp_path / "sim.toml").rename(tmp_path / "cell.toml")
        with started("console", "--no-open", folder=tmp_path) as process:
            console = Console(process, tmp_path)
            screen = Screen.of(browser, console.link())
            with Watcher(console.link()) as watcher:
                screen.hold()
                ask(endpoints, op="fault", name="arm.protective_stop")
                screen.shows("unlock", r"protective stop[\s\S]*I have looked: unlock")
                screen.page.click("#recover")
                watcher.until(lambda state: idle(state) and state["safety"]["arm"] == "normal", 60.0)
                screen.page.wait_for_selector("#unlock", state="hidden")
                screen.page.click("[data-do=home]")
                watcher.until(lambda state: state["run"] is not None and state["run"]["kind"] == "homing")
                ask(endpoints, op="fault", name="arm.protective_stop")
                watcher.until(lambda state: state["question"] is not None)
                screen.page.fill("#question textarea", "the way is clear")
                screen.page.click("#question [data-choice=confirm]")
                watcher.until(lambda state: idle(state) and state["last"]["outcome"] == "done", 90.0)
            assert screen.complaints == []
            screen.close()
