"""What passes on a device's wire, for whoever listens: each link tells what it sends and what comes, as it is.

Nobody listens most of the time, and then this costs nothing. A listener is called by the thread that drives the device:
it only puts the thing aside.
"""

from __future__ import annotations

from collections.abc import Callable

Listener = Callable[[bool, object], None]
"""Given whether it was sent, and what: bytes of a serial line, a `can.Message`, a line of text, or a record of values
where a maker's library keeps the bytes to itself."""


class Traffic:
    """The traffic of one device; `listener` is told all of it."""

    def __init__(self) -> None:
        self.listener: Listener | None = None

    def sent(self, what: object) -> None:
        """The link sends this."""
        if (listener := self.listener) is not None:
            listener(True, what)

    def received(self, what: object) -> None:
        """The link has received this."""
        if (listener := self.listener) is not None:
            listener(False, what)
