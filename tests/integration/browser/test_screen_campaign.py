"""What takes longer: a whole dry run on the screen with a person's word, every end of a held button, a lost server."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable

import pytest
from playwright.sync_api import Browser, Playwright

from lab.bench.wires.soak import counted
from tests.support.browser.pressing import SEEN_S, STOPS_WITHIN_S, idle, joint, kill, press
from tests.support.browser.screen import LOCAL, PHONE, Console, Screen, console_of, opened_browser
from tests.support.browser.watcher import Watcher
from tests.support.wire.cells import started

pytestmark = [pytest.mark.wire, pytest.mark.campaign]

FAULT = "arm.protective_stop@laser_sweep:40%"


def test_a_whole_dry_run_is_seen_and_decided_upon(browsers: Playwright, tmp_path):
    """All the way to the placed part, with a protective stop on the way that waits for a person."""
    command = ("dry-run", "--console", "--no-open", "--seed", "3", "--inject", FAULT)
    with started(*command, folder=tmp_path) as process:
        console = Console(process, tmp_path)
        browser = opened_browser(browsers, drawn=True)
        screen = Screen.of(browser, console.link())
        page = screen.page
        screen.hold()
        screen.shows("question-title", "person has to look", timeout=400.0)
        assert page.locator("#question .why").inner_text()
        # The stop button stays in reach beside the question.
        assert page.locator("#stop").is_enabled()
        page.click("#question [data-choice=confirm]")
        screen.shows("question", "Write down why")
        page.fill("#question textarea", "the arm is free, nothing lies in its way")
        page.click("#question [data-choice=confirm]")
        screen.shows("run-text", "last job: placed", timeout=300.0)
        # Both cameras were seen, and a cloud grew.
        screen.shows("legend-count", r"[1-9][\d,.]{3,} points")
        for camera in ("target_camera", "scan_camera"):
            assert "no picture" not in page.inner_text(f"[data-camera={camera}] output")
        page.click("#tab-runs")
        page.click("#runs button.link >> nth=0")
        screen.shows("run-detail", "placed")
        page.click("#run-detail button:text('Replay')")
        screen.shows("replay-title", "not live")
        screen.shows("replay-at", "place")
        page.click("#replay-end")
        assert screen.complaints == []
        assert screen.hosts <= LOCAL
        browser.close()
    reports = [report.read_text(encoding="utf-8") for report in (tmp_path / "runs").glob("*/report.json")]
    assert any("nothing lies in its way" in report for report in reports)


ENDS: dict[str, Callable[[Screen], None]] = {
    "blur": lambda screen: screen.page.evaluate("window.dispatchEvent(new Event('blur'))"),
    "another focus": lambda screen: screen.page.focus("#speed"),
    "slid off": lambda screen: screen.page.mouse.move(640, 300),
    "other button": lambda screen: screen.page.mouse.down(button="right"),
    "second touch": lambda screen: screen.page.evaluate(
        "document.dispatchEvent(new PointerEvent('pointerdown', {pointerId: 77, pointerType: 'touch'}))"
    ),
    # A page under test is always shown and in front: told as a browser tells it.
    "another page in front": lambda screen: screen.page.evaluate(
        "document.dispatchEvent(new Event('visibilitychange'))"
    ),
    "navigated away": lambda screen: screen.page.goto("about:blank"),
    "closed": lambda screen: screen.page.close(),
    "stop": lambda screen: screen.page.evaluate("document.getElementById('stop').click()"),
}


@pytest.mark.parametrize("end", ENDS)
def test_whatever_ends_holding_a_button_ends_the_motion(end: str, browser: Browser, console: Console, watcher: Watcher):
    screen = Screen.of(browser, console.link())
    press(screen, watcher)
    begun = time.monotonic()
    ENDS[end](screen)
    assert watcher.still(joint) - begun < STOPS_WITHIN_S + SEEN_S
    screen.close()
    watcher.until(lambda state: idle(state) and state["holder"] is None, timeout=30.0)


def test_a_killed_browser_stops_the_arm(browsers: Playwright, console: Console, watcher: Watcher):
    browser = opened_browser(browsers)
    screen = Screen.of(browser, console.link())
    press(screen, watcher)
    kill(browser)
    begun = time.monotonic()
    assert watcher.still(joint) - begun < STOPS_WITHIN_S + SEEN_S
    watcher.until(lambda state: state["holder"] is None, timeout=30.0)


def test_a_lost_server_is_told_at_once(browser: Browser, tmp_path):
    with console_of(tmp_path) as console:
        screen = Screen.of(browser, console.link())
        console.process.send_signal(signal.SIGSTOP)
        begun = time.monotonic()
        screen.page.wait_for_selector("#lost:not([hidden])")
        assert time.monotonic() - begun < 2.0
        screen.shows("lost", "NO CONNECTION.*emergency stop")
        assert screen.page.locator("body.stale").count() == 1
        console.process.send_signal(signal.SIGCONT)
        screen.page.wait_for_selector("#lost", state="hidden")
        screen.close()


@pytest.mark.parametrize("size", [(1280, 800), PHONE], ids=["wide", "phone"])
def test_stop_is_in_sight_and_nothing_is_cut_off(
    size: tuple[int, int], browsers: Playwright, console: Console, tmp_path
):
    browser = opened_browser(browsers, drawn=True)
    screen = Screen.of(browser, console.link(), size)
    page = screen.page
    box = page.locator("#stop").bounding_box()
    assert (
        box["x"] >= 0 and box["y"] >= 0 and box["x"] + box["width"] <= size[0] and box["y"] + box["height"] <= size[1]
    )
    # Scrolled to the very end it is still there, and over everything.
    page.evaluate("window.scrollTo(0, document.body.scrollHeight)")
    here = page.evaluate(
        "() => { const b = document.getElementById('stop').getBoundingClientRect();"
        " return document.elementFromPoint(b.x + b.width / 2, b.y + b.height / 2).closest('button')?.id }"
    )
    assert here == "stop"
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    page.screenshot(path=tmp_path / f"{size[0]}.png")
    browser.close()


SOAKED_S, MOST_MB_A_HOUR, A_PAGE_OF_MEMORY_MB = 300.0, 1.0, 0.3
BUSY = "while True: pass"


def test_a_console_that_goes_on_does_not_grow(browsers: Playwright, tmp_path):
    """Idle, with a page that homes the rail, and while its readings come late: the second half of each phase counts."""
    with console_of(tmp_path, "--speed", "0.3") as console:
        link, browser = console.link(), opened_browser(browsers)

        def grown(phase: str) -> None:
            memory = []
            for _ in range(2):
                browser.contexts[0].pages[0].wait_for_timeout(500 * SOAKED_S)
                memory.append({name: row["memory_mb"] for name, row in counted(console.process.pid).items()})
            for name, after in memory[1].items():
                most = MOST_MB_A_HOUR * SOAKED_S / 7200 + A_PAGE_OF_MEMORY_MB
                print(f"{phase}: {name}: {after:.1f} MB, {after - memory[0][name]:+.2f} (allowed {most:.2f})")
                assert after - memory[0][name] <= most, (phase, name)

        browser.new_page()
        grown("idle")
        screen = Screen.of(browser, link)
        screen.hold()
        for _ in range(3):
            screen.page.click("[data-do=home]")
            screen.page.wait_for_timeout(40_000)
        grown("a page")
        busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(8)]
        try:
            grown("late readings")
        finally:
            for one in busy:
                one.kill()
                one.wait()
        screen.close()
        browser.close()
