"""The operator's screen in a real browser, before a cell that is simulated behind its real protocols."""

from __future__ import annotations

import time

import pytest

from tests.browser.pressing import SEEN_S, STOPS_WITHIN_S, idle, joint, leave, press
from tests.browser.screen import LOCAL, Screen
from tests.browser.watcher import Watcher

# As in tests/wire: devices keep deadlines on the wall, which a busy machine cannot always.
pytestmark = [pytest.mark.wire, pytest.mark.flaky(reruns=3, reruns_delay=10)]


def test_a_run_is_watched_paused_and_stopped(screen: Screen, watcher: Watcher) -> None:
    screen.shows("world", "SIMULATED.*seed 3")
    # Who does not hold the cell can do one thing alone.
    assert screen.page.locator("#start").is_disabled()
    assert screen.page.locator("#manual").is_disabled()
    assert screen.page.locator("#pace").is_disabled()
    assert screen.page.locator("#stop").is_enabled()
    assert "not an emergency stop" in screen.page.inner_text("#stop")
    screen.hold()
    screen.page.click("#start")
    run = watcher.until(lambda state: state["run"])["run"]
    assert run["job"] == "pot"
    screen.shows("run-title", "job pot")
    screen.page.click("#pause")
    watcher.until(lambda state: state["run"]["state"] in ("pausing", "paused"))
    screen.shows("run-title", "paus")
    screen.page.click("#go-on")
    watcher.until(lambda state: state["run"]["state"] == "running")
    screen.page.fill("#pace", "50")
    watcher.until(lambda state: state["pace"] == 0.5)
    screen.shows("pace-said", "50 %")
    screen.page.fill("#pace", "100")
    watcher.until(lambda state: state["pace"] == 1.0)
    screen.page.click("#stop")
    ended = watcher.until(idle)
    screen.shows("stop-said", "was carried out")
    screen.shows("run-title", "No run")
    # A stop holds direct commands until a person says that they have looked.
    assert ended["safety"]["stopped"]
    screen.page.click("#clear-stop")
    watcher.until(lambda state: not state["safety"]["stopped"])
    assert screen.hosts <= LOCAL
    assert screen.complaints == []


def test_a_held_button_moves_the_arm_until_it_is_let_go(screen: Screen, watcher: Watcher) -> None:
    press(screen, watcher)
    # The speed is steady: a late beat here and there does not make it halt.
    begin = joint(watcher.state)
    time.sleep(0.5)
    assert abs(joint(watcher.state) - begin) > 0.02
    released = time.monotonic()
    screen.page.mouse.up()
    assert watcher.still(joint) - released < STOPS_WITHIN_S + SEEN_S
    screen.shows("jog-said", "let go|ended|stopped")
    leave(screen, watcher)


def test_a_page_that_hangs_while_a_button_is_held_stops_the_arm(screen: Screen, watcher: Watcher) -> None:
    press(screen, watcher)
    hung = time.monotonic()
    screen.page.evaluate("setTimeout(() => { const end = Date.now() + 1500; while (Date.now() < end); })")
    assert watcher.still(joint) - hung < STOPS_WITHIN_S + SEEN_S
    # It comes to itself with the button still down: that press moves nothing any more.
    stood = joint(watcher.state)
    time.sleep(1.8)
    assert joint(watcher.state) == pytest.approx(stood, abs=1e-4)
    screen.page.mouse.up()
    leave(screen, watcher)


def test_a_point_has_the_colour_of_its_deviation_and_another_one_on_another_scale(screen: Screen) -> None:
    colours = screen.page.evaluate(
        """async () => {
            const { Cloud } = await import(new URL('cloud.js', document.querySelector('script[type=module]').src));
            const cloud = new Cloud(() => {});
            cloud.add(new Float32Array([-0.2, 0, 0.2, 0.1, 0.9, NaN].flatMap((off) => [0, 0, 0, off])));
            const of = (k) => Array.from(cloud.color.array.slice(3 * k, 3 * k + 3));
            const seen = () => Array.from({ length: cloud.count }, (_, k) => of(k));
            const fine = seen();
            cloud.scale(0.4);
            return [fine, seen()];
        }"""
    )
    fine, wide = colours
    blue, middle, red = fine[0], fine[1], fine[2]
    assert blue[2] > 0.7 > 0.2 > blue[0]
    assert red[0] > 0.7 > 0.2 > red[2]
    assert max(middle) - min(middle) < 0.1
    assert fine[4] == red, "what is beyond the scale has the colour of its end"
    # Half of the way to the end: between the colours beside it.
    assert wide[0] == pytest.approx([0.35, 0.7, 0.95]) and wide[2] == pytest.approx([0.98, 0.65, 0.3])
    assert wide[1] == middle and wide[5] == fine[5], "zero and unknown are the same on every scale"
    assert fine[5] not in (blue, middle, red)
    assert fine[3] == wide[2]


def test_a_dry_run_shows_how_far_it_is_and_is_cancelled(screen: Screen, watcher: Watcher) -> None:
    screen.hold()
    screen.page.click("#dry-run")
    screen.shows("dry-said", "Dry run of pot: .+ …")
    assert screen.page.locator("#dry-bar progress").is_visible()
    assert screen.page.locator("#dry-run").is_disabled()
    screen.page.click("#dry-cancel")
    screen.shows("dry-said", "Dry run of pot: cancelled")
    assert not screen.page.locator("#dry-bar").is_visible()
    watcher.until(lambda state: state["dry_run"]["outcome"] == "cancelled")
    leave(screen, watcher)
