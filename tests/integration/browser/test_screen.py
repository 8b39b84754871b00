"""The operator's screen in a real browser, before a cell that is simulated behind its real protocols."""

import time

import pytest
from playwright.sync_api import Browser, Route

from tests.support.browser.pressing import SEEN_S, STOPS_WITHIN_S, idle, joint, leave, press
from tests.support.browser.screen import LOCAL, Console, Screen
from tests.support.browser.watcher import Watcher

# As in tests/wire: devices keep deadlines on the wall, which a busy machine cannot always.
pytestmark = pytest.mark.wire


def test_a_run_is_watched_paused_and_stopped(screen: Screen, watcher: Watcher):
    screen.shows("world", "SIMULATED.*seed 3")
    # Who does not hold the cell can do one thing alone.
    assert screen.page.locator("#start").is_disabled()
    assert screen.page.locator("#manual").is_disabled()
    assert screen.page.locator("#pace").is_disabled()
    assert screen.page.locator("#stop").is_enabled()
    assert "not an emergency stop" in screen.page.inner_text("#stop")
    screen.hold()
    screen.page.fill("#count", "2")
    screen.page.click("#start")
    run = watcher.until(lambda state: state["run"])["run"]
    assert run["job"] == "pot"
    screen.shows("run-title", "job pot")
    screen.shows("queue-title", "Queue of 2 parts, pot")
    screen.page.click("[data-parts=end]")
    screen.shows("queue-said", "0 of 2 done, ends after this part")
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
    screen.shows("queue-said", "ended")
    screen.shows("queue-counts", "1.*stopped")
    # A stop holds direct commands until a person says that they have looked.
    assert ended["safety"]["stopped"]
    screen.page.click("#clear-stop")
    watcher.until(lambda state: not state["safety"]["stopped"])
    assert screen.hosts <= LOCAL
    assert screen.complaints == []


def test_a_held_button_moves_the_arm_until_it_is_let_go(screen: Screen, watcher: Watcher):
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


def test_a_page_that_hangs_while_a_button_is_held_stops_the_arm(screen: Screen, watcher: Watcher):
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


def test_a_point_has_the_colour_of_its_deviation_and_another_one_on_another_scale(screen: Screen):
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


def test_a_dry_run_shows_how_far_it_is_and_is_cancelled(screen: Screen, watcher: Watcher):
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


SIZES = [(1280, 800), (768, 1024)]
RUN = {
    "kind": "job", "run": "20260101T000000-abcd", "job": "pot", "state": "asking", "step": "laser_sweep", "attempt": 1,
    "fraction": 0.4, "text": "line 48 of 120", "elapsed_s": 40.0, "left_s": None, "steps": [],
}  # fmt: skip
ASKED = {
    "kind": "confirm", "number": 1, "step": "laser_sweep", "code": "arm.protective_stop",
    "reason": "the arm has stopped", "numbers": [], "picture": None,
    "choices": [{"choice": "confirm"}, {"choice": "abort"}],
}  # fmt: skip
BOXES = """() => Object.fromEntries(['question', 'stage', 'stop', 'state'].map((id) => {
    const b = document.getElementById(id).getBoundingClientRect();
    return [id, [b.left, b.top, b.right, b.bottom]];
}))"""


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_question_stands_beside_the_view_and_says_what_comes_of_an_answer(
    size: tuple[int, int], browser: Browser, console: Console
):
    changes: dict[str, object] = {"run": RUN, "question": ASKED}
    screen = Screen.of(browser, console.link(), size, changes=changes)
    page = screen.page
    screen.shows("state", "WAITS FOR YOU")
    screen.shows("question", "flange stands at x .* mm.*laser sweep begins anew.*ends as aborted")
    screen.shows("question", r"laser sweep: line 48 of 120 \(40 %\)")
    boxes = page.evaluate(BOXES)
    for other in ("stage", "stop"):
        (left, top, right, bottom), (a, b, c, d) = boxes["question"], boxes[other]
        assert right <= a or c <= left or bottom <= b or d <= top, f"the question covers the {other}"
    left, top, right, bottom = boxes["question"]
    assert left >= 0 and right <= size[0] and top >= 0 and bottom <= size[1]
    a, b, c, d = boxes["stage"]
    assert min(c, right) - max(a, left) <= 0 < min(d, bottom) - max(b, top), "it stands beside the view"
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert boxes["state"][3] - boxes["state"][1] >= 36, "legible from two metres"
    screen.hold()
    page.click("#question .choices button >> nth=0")
    assert page.input_value("#question textarea") == "nothing touches the arm"
    # A second attempt that runs is not told the fault of a run before it as its own end.
    fault = {"device": "arm", "code": "c", "text": "arm: lost", "remedy": "ended the run"}
    ended = {**fault, "t": time.time(), "over": True}
    changes |= {"question": None, "run": {**RUN, "state": "running", "attempt": 2}, "faults": [ended]}
    screen.shows("state", "RUNNING")
    screen.shows("run-text", "attempt 2")
    assert "ended the run" not in page.inner_text("body")
    screen.close()


ENDS = [
    ({"outcome": "placed", "figure": {"mm": 0.0213, "kind": "true"}}, "PLACED 0.02 mm", "true place error"),
    ({"outcome": "placed", "figure": {"mm": 0.31, "kind": "stated"}}, "PLACED ± 0.31 mm", "reckoned, not measured"),
    ({"outcome": "faulted", "figure": None}, "FAULT", "the arm was lost"),
]


def test_a_start_is_said_at_once_and_once_and_a_run_ends_with_its_figure(browser: Browser, console: Console):
    changes: dict[str, object] = {}
    screen = Screen.of(browser, console.link(), changes=changes)
    page = screen.page
    screen.hold()
    asked: list[str] = []

    def slow(route: Route) -> None:
        asked.append(str(route.request.post_data))
        page.wait_for_timeout(1000)
        route.fulfill(status=409, json={"ok": False, "error": "LimitError", "text": "the battery is empty"})

    page.route("**/api/do", slow)
    shown = page.evaluate(
        "() => { const b = document.getElementById('start'); b.click(); b.click(); b.form.requestSubmit();"
        " const of = (id) => document.getElementById(id);"
        " return [of('state').textContent, of('run-text').textContent, b.disabled, of('answer').hidden]; }"
    )
    # In the very task that the press was heard in: well below 200 ms.
    assert shown == ["STARTING", "Starting job pot …", True, True]
    screen.shows("answer", "the battery is empty")
    assert len(asked) == 1
    page.wait_for_selector("#start:enabled")
    for last, word, sentence in ENDS:
        changes["last"] = {"run": "x", "kind": "job", "reason": "the arm was lost", "t": 0.0, **last}
        changes["safety"] = {"stopped": last["outcome"] == "faulted"}
        screen.shows("state", word.replace("+", "."))
        screen.shows("state-text", sentence)
    changes |= {"safety": {"stopped": False}, "queue": {"state": "holding", "part": 1, "count": 2, "counts": {}}}
    screen.shows("state", "QUEUE HOLDS")
    page.unroute("**/api/do")
    screen.close()


def test_the_first_load_is_small_and_the_next_asks_only_whether_it_is_the_same(browser: Browser, console: Console):
    """Over the wire, headers and all; without it three.js alone had 1.3 MB."""
    screen = Screen.of(browser, console.link())
    sizes = """() => ['navigation', 'resource'].flatMap((type) => performance.getEntriesByType(type))
        .map((entry) => [new URL(entry.name).pathname, entry.transferSize])"""
    screen.shows("world", "SIMULATED")
    first = dict(screen.page.evaluate(sizes))
    assert {"/api/cell", "/static/vendor/three.module.min.js", "/static/style.css"} <= set(first)
    assert sum(first.values()) <= 500_000, first
    screen.page.reload()
    screen.shows("world", "SIMULATED")
    again = dict(screen.page.evaluate(sizes))
    assert again["/static/vendor/three.module.min.js"] < 1000
    assert sum(again.values()) - again["/api/cell"] < 20_000, again
    print(f"first load {sum(first.values())} bytes, next {sum(again.values())}")
    screen.close()


def test_an_error_is_told_in_a_sentence(screen: Screen):
    answers = {
        '{"ok": false, "error": "missing", "text": "there is no such run"}': "There is no such run.",
        '{"detail": 1}': "The server refused this .404.. Load the page again.",
    }
    bodies = iter(answers)
    screen.page.route("**/api/runs", lambda route: route.fulfill(status=404, body=next(bodies)))
    for sentence in answers.values():
        screen.page.click("#tab-runs")
        screen.shows("answer", f"^{sentence}")
