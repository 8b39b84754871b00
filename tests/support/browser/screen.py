"""The operator's screen as tests use it: the server of a simulated cell, a browser, and a person before the page."""

import json
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, Page, Playwright, Request, WebSocketRoute, expect

from tests.support.wire.cells import started

WIDE, PHONE = (1280, 800), (390, 844)
LINK = re.compile(r"https?://\S+/enter\?token=\S+")
DRAWN = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader")
"""3-D on the processor: dear, so that only tests which look at it ask for it."""
FLAT = ("--disable-gpu", "--disable-3d-apis")
LOCAL = {"127.0.0.1", "localhost"}


def browser_path() -> str | None:
    """The system's own browser, None where there is none."""
    return next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
    )


def opened_browser(playwright: Playwright, drawn: bool = False) -> Browser:
    """A new one, without a window."""
    arguments = ["--headless=new", "--no-sandbox", *(DRAWN if drawn else FLAT)]
    return playwright.chromium.launch(executable_path=browser_path(), args=arguments, chromium_sandbox=False)


class Console:
    """`cell console` that is going on in a folder; it prints a new link each time one was used."""

    def __init__(self, process: Any, folder: Path) -> None:
        self.process = process
        self.folder = folder
        self._links: Queue[str] = Queue()
        for stream in (process.stdout, process.stderr):
            threading.Thread(target=self._read, args=(stream,), daemon=True).start()

    def _read(self, stream: Any) -> None:
        for line in stream:
            for link in LINK.findall(line):
                self._links.put(link)

    def link(self, timeout: float = 120.0) -> str:
        """One that nobody has used."""
        try:
            return self._links.get(timeout=timeout)
        except Empty:
            raise AssertionError(f"no link came within {timeout:g} s; ended: {self.process.poll()}") from None


@contextmanager
def console_of(folder: Path, *arguments: str) -> Iterator[Console]:
    """A simulated cell of seed 3 and its screen."""
    with started("console", "--sim", "all", "--seed", "3", "--no-open", *arguments, folder=folder) as process:
        yield Console(process, folder)


@dataclass
class Screen:
    """One page; notes whom it asks and what it complains of."""

    page: Page
    hosts: set[str] = field(default_factory=set)
    complaints: list[str] = field(default_factory=list)

    @classmethod
    def of(
        cls, browser: Browser, link: str, size: tuple[int, int] = WIDE, changes: dict[str, Any] | None = None
    ) -> "Screen":
        """A page that has followed the link and hears the cell; of its state it is told these `changes` instead."""
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        if changes is not None:
            context.route_web_socket("**/live", lambda link: changed(link, changes))
        screen = cls(context.new_page())
        screen.page.set_default_timeout(20_000)
        screen.page.on("request", screen._asked)
        screen.page.on("websocket", lambda socket: screen.hosts.add(str(urlsplit(socket.url).hostname)))
        screen.page.on("pageerror", lambda error: screen.complaints.append(str(error)))
        screen.page.on("console", lambda said: screen._said(said.type, said.text))
        screen.page.goto(link)
        # The link leads on to the page. Neither it nor the page's key stays in the address.
        screen.page.wait_for_url("**/")
        assert "token" not in screen.page.url and "key" not in screen.page.url
        screen.page.wait_for_selector("body:not(.stale)")
        return screen

    def _asked(self, request: Request) -> None:
        if not request.url.startswith(("blob:", "data:")):
            self.hosts.add(str(urlsplit(request.url).hostname))

    def _said(self, kind: str, text: str) -> None:
        # Without 3-D the page says so itself.
        if kind == "error" and "WebGL" not in text:
            self.complaints.append(text)

    def shows(self, where: str, pattern: str, timeout: float = 20.0) -> None:
        """Wait until the text of an element, by its id, matches."""
        expect(self.page.locator(f"#{where}")).to_have_text(re.compile(pattern, re.IGNORECASE), timeout=1e3 * timeout)

    def hold(self, name: str = "Ann") -> None:
        """Take the cell in hand."""
        self.page.fill("#hold-name", name)
        self.page.click("#hold-form button")
        self.shows("holder", "You hold")

    def manual(self, group: str) -> None:
        """Manual mode, and what to jog."""
        if self.page.get_attribute("#manual", "aria-pressed") != "true":
            self.page.click("#manual")
        self.page.click(f"#jog-devices button:text-is('{group}')")

    def close(self) -> None:
        """Leave."""
        self.page.context.close()


def changed(link: WebSocketRoute, changes: dict[str, Any]) -> None:
    """Pass on a live link, with `changes` in what is told of the cell's state."""
    server = link.connect_to_server()

    def came(message: str | bytes) -> None:
        if isinstance(message, str) and (said := json.loads(message))["type"] == "state":
            message = json.dumps({**said, **changes})
        link.send(message)

    server.on_message(came)
