"""Moving by holding a button: one press, from its first beat to its last.

A press that has ended, for whatever reason, moves nothing any more: its later beats are thrown away, so that what comes
late or again after a pause begins no motion. Two watch over it: the thread that began the motion, and beside this
process the one that `drivers.interfaces.Attended` tells of.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.errors import DeviceError
from drivers.interfaces import ATTENDED_S

LATE_S = 0.25
"""A beat that was longer under way than the quickest of its page by more than this is none: the button may be up."""


@dataclass(eq=False)
class Press:
    """One press of a button: which client, its number, and what it moves (`sign` +1 or -1)."""

    client: str
    number: int
    device: str
    axis: str
    sign: int
    heard: float = field(default_factory=time.monotonic)
    ended: str | None = None
    beat: Callable[[], None] | None = None
    """Tells the watch beside the device, once that stands."""

    def __post_init__(self) -> None:
        self._end = threading.Event()

    def renew(self) -> None:
        """A beat has come."""
        if self.over() is not None:
            return
        self.heard = time.monotonic()
        if self.beat is not None:
            try:
                self.beat()
            except DeviceError as error:
                self.end(str(error))

    def end(self, why: str) -> None:
        """It is over."""
        if self.ended is None:
            self.ended = why
        self._end.set()

    def over(self) -> str | None:
        """Why it is over, or None while the button is held."""
        if self.ended is None and (silent := time.monotonic() - self.heard) > ATTENDED_S:
            self.end(f"no beat came for {1e3 * silent:.0f} ms (at most {1e3 * ATTENDED_S:.0f}); let go and press again")
        return self.ended

    def wait(self, seconds: float) -> None:
        """Wait a moment, or until it is over."""
        self._end.wait(seconds)


class Presses:
    """The presses of all clients: which one is held now, and which numbers are used up."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: dict[str, int] = {}
        self._quickest: dict[str, float] = {}
        self.present: Press | None = None

    def beat(
        self, client: str, number: int, device: str, axis: str, sign: int, at_ms: float | None = None
    ) -> Press | None:
        """A beat has come: a new press, which is to begin a motion, or None.

        `at_ms` is when the page sent it, on the page's own clock: one that was long under way counts for nothing. A
        beat of another button ends what is held, and begins nothing.
        """
        with self._lock:
            if at_ms is not None and self._late(client, at_ms):
                return None
            held = self.present
            if held is not None and held.over() is None:
                if (held.client, held.number, held.device, held.axis, held.sign) == (
                    client, number, device, axis, sign,
                ):  # fmt: skip
                    held.renew()
                    return None
                held.end("another button was pressed")
                self._last[client] = max(number, self._last.get(client, 0))
                return None
            if number <= self._last.get(client, 0):
                return None
            self._last[client] = number
            self.present = Press(client, number, device, axis, sign)
            return self.present

    def end(self, client: str, why: str) -> None:
        """This client's button is up, or the client is gone."""
        with self._lock:
            if self.present is not None and self.present.client == client:
                self.present.end(why)

    def end_all(self, why: str) -> None:
        """Whoever holds a button: it counts no more."""
        with self._lock:
            if self.present is not None:
                self.present.end(why)

    def left(self, client: str) -> None:
        """A client is gone."""
        self.end(client, "the page is gone")
        with self._lock:
            self._last.pop(client, None)
            self._quickest.pop(client, None)

    def _late(self, client: str, at_ms: float) -> bool:
        behind = time.monotonic() - 1e-3 * at_ms
        quickest = self._quickest[client] = min(behind, self._quickest.get(client, behind))
        return behind - quickest > LATE_S
