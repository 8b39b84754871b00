"""A held button, and what somebody else sees of the arm meanwhile."""

import os
import signal
from typing import Any

from playwright.sync_api import Browser

from tests.support.browser.screen import Screen
from tests.support.browser.watcher import Watcher

STOPS_WITHIN_S = 0.25
SEEN_S = 0.15
"""How late the looker-on is told at most: two states, and a busy machine."""


def joint(state: dict[str, Any]) -> float:
    """The first joint's angle, rad."""
    return float(state["joints"][0])


def idle(state: dict[str, Any]) -> bool:
    """Whether nothing goes on."""
    return state["run"] is None and not state["manual"]


def press(screen: Screen, watcher: Watcher) -> None:
    """Hold the button of joint 1 until the arm moves."""
    screen.hold()
    screen.manual("arm joints")
    watcher.until(lambda state: state["manual"])
    before = joint(watcher.state)
    screen.page.hover("#jog-axes .hold-button >> nth=1")
    screen.page.mouse.down()
    watcher.until(lambda state: abs(joint(state) - before) > 0.01)


def leave(screen: Screen, watcher: Watcher) -> None:
    """Let go of the cell; manual mode ends with that."""
    screen.page.click("#leave")
    watcher.until(idle)


def kill(browser: Browser) -> None:
    """End the browser's process so that no page can say good-bye."""
    processes = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    for process in sorted(processes, key=lambda process: process["type"] != "browser"):
        try:
            os.kill(process["id"], signal.SIGKILL)
        except ProcessLookupError:
            continue
