"""What waits to be sent to one page: of what is shown only the newest, of the cloud every increment up to a bound.

A page that reads slowly sees less often, and holds nobody up.
"""

from __future__ import annotations

import asyncio
from collections import deque

MOST_EVENTS, MOST_CLOUDS, MOST_WORDS = 100, 64, 100

Item = str | bytes


class Mailbox:
    """For one reader, in the event loop's thread."""

    def __init__(self) -> None:
        self._words: deque[Item] = deque(maxlen=MOST_WORDS)
        self._events: deque[Item] = deque(maxlen=MOST_EVENTS)
        self._newest: dict[str, Item] = {}
        self._clouds: deque[Item] = deque(maxlen=MOST_CLOUDS)
        self._news = asyncio.Event()

    def say(self, item: Item) -> None:
        """Something to this page alone, in its order."""
        self._put(self._words, item)

    def event(self, item: Item) -> None:
        """Something for the list; who is slow misses the oldest."""
        self._put(self._events, item)

    def cloud(self, item: Item) -> None:
        """An increment of the cloud."""
        self._put(self._clouds, item)

    def show(self, what: str, item: Item) -> None:
        """The newest of its kind, in place of one that was not sent yet."""
        self._newest[what] = item
        self._news.set()

    def clear_cloud(self) -> None:
        """What waits of the cloud is not wanted any more."""
        self._clouds.clear()

    async def take(self) -> Item:
        """The next to send; waits for it."""
        while True:
            for queue in (self._words, self._events):
                if queue:
                    return queue.popleft()
            if self._newest:
                what = next(iter(self._newest))
                return self._newest.pop(what)
            if self._clouds:
                return self._clouds.popleft()
            self._news.clear()
            await self._news.wait()

    @property
    def waiting(self) -> int:
        """How much waits."""
        return len(self._words) + len(self._events) + len(self._newest) + len(self._clouds)

    def _put(self, queue: deque[Item], item: Item) -> None:
        queue.append(item)
        self._news.set()
