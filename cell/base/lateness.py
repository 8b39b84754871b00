"""How late this computer wakes a thread that sleeps: one that is too busy does not feed an arm in time.

Not for the virtual clock, on which nobody sleeps.
"""

import threading
import time
from collections import deque

PERIOD_S = 0.05
KEPT = 200
"""How many of the newest naps count: ten seconds of them."""
MOST_USUAL_S = 0.008
"""In 95 % of the naps, as `cell doctor` asks: one period of an arm that is fed 125 times a second."""
MOST_S = 0.1
"""In the worst nap, before a device that was not heard in time is laid to this computer."""


class Lateness:
    """Naps in a thread of its own while `begin` was said more often than `end`."""

    def __init__(self) -> None:
        self._late: deque[float] = deque(maxlen=KEPT)
        self._users = 0
        self.rate = 1.0
        self._lock = threading.Lock()
        self._over = threading.Event()

    def begin(self, rate: float = 1.0) -> None:
        """Measure from now on; the cell's clock runs at `rate` times the wall's pace."""
        with self._lock:
            self._users, self.rate = self._users + 1, rate
            if self._users == 1:
                self._late.clear()
                self._over = threading.Event()
                threading.Thread(target=self._nap, args=(self._over,), name="lateness", daemon=True).start()

    def end(self) -> None:
        """Measure no longer for this user."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._over.set()

    @property
    def worst(self) -> float:
        """Of the newest naps, s; 0 while nothing is measured."""
        return max(self._late, default=0.0) if self._users else 0.0

    @property
    def usual(self) -> float:
        """What 95 % of the newest naps keep, s; 0 while nothing is measured."""
        late = sorted(self._late) if self._users else []
        return late[int(0.95 * len(late))] if late else 0.0

    def _nap(self, over: threading.Event) -> None:
        due = time.monotonic() + PERIOD_S
        while not over.wait(PERIOD_S):
            self._late.append(time.monotonic() - due)
            due = time.monotonic() + PERIOD_S


LATENESS = Lateness()


def busy_words() -> str | None:
    """What a person is told before a run begins on a computer that wakes up late."""
    if (usual := LATENESS.usual) <= MOST_USUAL_S:
        return None
    return (
        f"This computer is too busy: it wakes up {1e3 * usual:.0f} ms late, allowed {1e3 * MOST_USUAL_S:.0f} ms. "
        "An arm that is fed late stops. End what else computes here."
    )
