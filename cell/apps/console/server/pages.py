"""The pages that are open: what each is sent, what each says, and what of it goes on to the cell."""

import asyncio
import itertools
import json
import secrets
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect

from cell.apps.console.host.link import Beat, Joined, Left
from cell.apps.console.server.access import Bucket, checked_message
from drivers.errors import ConfigError

VERSION = 1
PROTOCOL = "cell"
"""Of the live link; asked for together with the session's key."""
BEAT_MS = 80
MOST_PAGES = 16
MOST_BYTES = 1024
"""Of a message from a page."""
TIMEOUT_S = 10.0
"""Wall seconds after which a page that takes nothing is given up."""
MOST_CLOUD_BYTES = 8_000_000
"""Of the cloud so far, which a page that comes later is given."""
MOST_EVENTS, MOST_CLOUDS, MOST_WORDS = 100, 64, 100
"""That wait for one page."""
MALFORMED, TOO_MANY, FULL = 1007, 1008, 1013
"""Codes with which a page's link is closed."""


class Mailbox:
    """What waits to be sent to one page: of what is shown only the newest, of the cloud every increment up to a bound.
    A page that reads slowly sees less often, and holds nobody up. In the event loop's thread."""

    def __init__(self) -> None:
        self._words: deque[str | bytes] = deque(maxlen=MOST_WORDS)
        self._events: deque[str | bytes] = deque(maxlen=MOST_EVENTS)
        self._newest: dict[str, str | bytes] = {}
        self._clouds: deque[str | bytes] = deque(maxlen=MOST_CLOUDS)
        self._news = asyncio.Event()

    def say(self, item: str | bytes) -> None:
        """Something to this page alone, in its order."""
        self._put(self._words, item)

    def event(self, item: str | bytes) -> None:
        """Something for the list; who is slow misses the oldest."""
        self._put(self._events, item)

    def cloud(self, item: str | bytes, anew: bool = False) -> None:
        """An increment of the cloud, in place of what waits of it if `anew`."""
        if anew:
            self._clouds.clear()
        self._put(self._clouds, item)

    def show(self, what: str, item: str | bytes) -> None:
        """The newest of its kind, in place of one that was not sent yet."""
        self._newest[what] = item
        self._news.set()

    async def take(self) -> str | bytes:
        """The next to send; waits for it."""
        while True:
            for queue in (self._words, self._events):
                if queue:
                    return queue.popleft()
            if self._newest:
                return self._newest.pop(next(iter(self._newest)))
            if self._clouds:
                return self._clouds.popleft()
            self._news.clear()
            await self._news.wait()

    def _put(self, queue: deque[str | bytes], item: str | bytes) -> None:
        queue.append(item)
        self._news.set()


class Page:
    """One open page."""

    def __init__(self, number: int) -> None:
        self.id = f"c{number}"
        self.key = secrets.token_urlsafe(24)
        self.mailbox = Mailbox()
        self.rate = Bucket(50.0, 100.0)


class Pages:
    """All of them. `notify` sends a message on to the cell unless too many wait, `stop` stops it; neither waits. In the
    event loop's thread."""

    def __init__(self, notify: Callable[[object], bool], stop: Callable[[], object]) -> None:
        self._notify = notify
        self._stop = stop
        self._numbers = itertools.count(1)
        self._pages: dict[str, Page] = {}
        self._cloud: list[bytes] = []
        self._pictures: dict[str, bytes] = {}

    def by_key(self, key: object) -> Page | None:
        """The page that has this key."""
        if not isinstance(key, str) or not key.isascii():
            return None
        return next((page for page in self._pages.values() if secrets.compare_digest(page.key, key)), None)

    @property
    def mailboxes(self) -> list[Mailbox]:
        """Of all pages."""
        return [page.mailbox for page in self._pages.values()]

    def say(self, client: str, words: Mapping[str, object]) -> None:
        """Something to one page, if it is still there."""
        if (page := self._pages.get(client)) is not None:
            page.mailbox.say(json.dumps(words))

    def picture(self, camera: str, packed: bytes) -> None:
        """A camera's newest, to all, and kept for those that come later."""
        self._pictures[camera] = packed
        for mailbox in self.mailboxes:
            mailbox.show(camera, packed)

    def cloud(self, header: Mapping[str, object], packed: bytes) -> None:
        """An increment of the cloud, to all, and kept for those that come later."""
        if header.get("reset"):
            self._cloud.clear()
        if sum(map(len, self._cloud)) + len(packed) <= MOST_CLOUD_BYTES:
            self._cloud.append(packed)
        for mailbox in self.mailboxes:
            mailbox.cloud(packed, bool(header.get("reset")))

    async def serve(self, socket: WebSocket, ticket: str) -> None:
        """One page's live link, until it is closed; `ticket` is its session's."""
        await socket.accept(PROTOCOL)
        if len(self._pages) >= MOST_PAGES:
            await socket.close(FULL, "too many pages are open; close one")
            return
        page = Page(next(self._numbers))
        if not self._notify(Joined(page.id)):
            await socket.close(FULL, "too much is being asked at once; wait a moment")
            return
        self._pages[page.id] = page
        hello = {"type": "hello", "id": page.id, "key": page.key, "ticket": ticket}
        page.mailbox.say(json.dumps({**hello, "version": VERSION, "beat_ms": BEAT_MS}))
        for part in self._cloud:
            page.mailbox.cloud(part)
        for camera, packed in self._pictures.items():
            page.mailbox.show(camera, packed)
        sending = asyncio.create_task(self._send(page, socket))
        try:
            # RuntimeError: closed by the sender meanwhile.
            with suppress(WebSocketDisconnect, RuntimeError):
                await self._hear(page, socket)
        finally:
            self._pages.pop(page.id, None)
            self._notify(Left(page.id))
            sending.cancel()
            await asyncio.wait([sending])

    async def _send(self, page: Page, socket: WebSocket) -> None:
        try:
            while True:
                item = await page.mailbox.take()
                sent = socket.send_text(item) if isinstance(item, str) else socket.send_bytes(item)
                await asyncio.wait_for(sent, TIMEOUT_S)
        except (TimeoutError, RuntimeError, WebSocketDisconnect):
            # One that takes nothing any more: its button is not held, either.
            self._notify(Left(page.id))
            self._pages.pop(page.id, None)
            with suppress(RuntimeError, WebSocketDisconnect, OSError):
                await socket.close(TOO_MANY)

    async def _hear(self, page: Page, socket: WebSocket) -> None:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            words = _words(message.get("text"))
            if words is None:
                await socket.close(MALFORMED, "not understood")
                return
            # Ahead of the rate: also the stop of one who says too much is carried out, before its link is closed.
            if words["type"] == "stop":
                self._stop()
            if not page.rate.take():
                await socket.close(TOO_MANY, "too many messages")
                return
            if words["type"] == "stop":
                continue
            try:
                checked_message(words)
            except ConfigError as error:
                # A close says at most 123 bytes.
                await socket.close(MALFORMED, str(error).encode()[:120].decode(errors="ignore"))
                return
            self._notify(Beat(page.id, words, end=words["type"] == "jog_end"))


def _words(text: object) -> dict[str, object] | None:
    """A message of a page; None when it is none."""
    if not isinstance(text, str) or len(text.encode()) > MOST_BYTES:
        return None
    try:
        words = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return words if isinstance(words, dict) and isinstance(words.get("type"), str) else None
