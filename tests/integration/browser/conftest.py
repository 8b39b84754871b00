"""One browser and one simulated cell with its screen for all tests that look at it."""

from collections.abc import Iterator

import pytest

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

from tests.support.browser.screen import Console, Screen, browser_path, console_of, opened_browser  # noqa: E402
from tests.support.browser.watcher import Watcher  # noqa: E402


@pytest.fixture(scope="module")
def browsers() -> Iterator[playwright.Playwright]:
    if browser_path() is None:
        pytest.skip("no Chromium is installed on this system (apt-get install chromium)")
    with playwright.sync_playwright() as made:
        yield made


@pytest.fixture(scope="module")
def browser(browsers: playwright.Playwright) -> Iterator[playwright.Browser]:
    """Draws no 3-D, which would keep the processor busy."""
    made = opened_browser(browsers)
    yield made
    made.close()


@pytest.fixture(scope="module")
def console(tmp_path_factory, browsers: object) -> Iterator[Console]:
    with console_of(tmp_path_factory.mktemp("screen")) as going:
        yield going


@pytest.fixture(scope="module")
def watcher(console: Console) -> Iterator[Watcher]:
    """Somebody else who looks on, without a browser."""
    with Watcher(console.link()) as made:
        yield made


@pytest.fixture(scope="module")
def left(browser: playwright.Browser) -> list[Screen]:
    """The page that the last test has left to the next."""
    return []


@pytest.fixture
def screen(browser: playwright.Browser, console: Console, left: list[Screen]) -> Iterator[Screen]:
    """A page of which nobody holds the cell; those of one that was not let go, by a test that failed, are closed."""
    made = left.pop() if left else Screen.of(browser, console.link())
    yield made
    if made.page.is_visible("#hold-form"):
        left.append(made)
    else:
        made.close()
