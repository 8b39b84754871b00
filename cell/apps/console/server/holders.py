"""Who looks at the cell through a page, and which one of them holds it: one does, the others see."""

from __future__ import annotations

import threading
from collections.abc import Callable

from drivers.errors import InterlockError

LONGEST_NAME = 40


class Holders:
    """The clients by their ids, with their names, and the one that holds. Callable from any thread.

    `lost` is called, with no lock held, whenever the one that held does so no more.
    """

    def __init__(self, lost: Callable[[], None]) -> None:
        self._lost = lost
        self._lock = threading.Lock()
        self._names: dict[str, str] = {}
        self._holder: str | None = None

    @property
    def holder(self) -> str | None:
        """The id of the client that holds, or None."""
        return self._holder

    def name(self, client: str) -> str:
        """What a client calls itself."""
        return self._names.get(client) or client

    def rows(self) -> list[dict[str, str]]:
        """Id and name of each client, in the order in which they came."""
        with self._lock:
            return [{"id": client, "name": name} for client, name in self._names.items()]

    def joined(self, client: str) -> None:
        """A page was opened."""
        with self._lock:
            self._names[client] = ""

    def left(self, client: str) -> None:
        """A page is gone, for whatever reason."""
        with self._lock:
            self._names.pop(client, None)
            held, self._holder = self._holder == client, None if self._holder == client else self._holder
        if held:
            self._lost()

    def hold(self, client: str, name: str) -> str:
        """Take the cell in hand; `InterlockError` while somebody else holds it."""
        with self._lock:
            if client not in self._names:
                raise InterlockError("cell", "this page has no live link, so it cannot hold the cell; load it again")
            if self._holder not in (None, client):
                raise InterlockError(
                    "cell", f"{self.name(str(self._holder))} holds it; ask them to hand it over, or to leave it"
                )
            self._names[client] = _clean(name)
            self._holder = client
            return f"{self.name(client)} holds the cell"

    def leave(self, client: str) -> str:
        """Let go of it."""
        self.require(client)
        with self._lock:
            self._holder = None
        self._lost()
        return "nobody holds the cell"

    def hand_over(self, client: str, to: str) -> str:
        """Give it to another client; `InterlockError` when there is none of that id."""
        self.require(client)
        with self._lock:
            if to not in self._names:
                raise InterlockError("cell", f"there is no page {to!r} that it could be handed over to")
            self._holder = to
        self._lost()
        return f"{self.name(to)} holds the cell"

    def require(self, client: str) -> None:
        """`InterlockError` unless this client holds."""
        if client != self._holder or client not in self._names:
            who = "nobody" if self._holder is None else self.name(self._holder)
            raise InterlockError("cell", f"this page does not hold it ({who} does); nothing was done. Take it in hand")


def _clean(name: str) -> str:
    """A name as it is shown to others and written to journals: one short line."""
    return " ".join("".join(c for c in name if c.isprintable()).split())[:LONGEST_NAME]
