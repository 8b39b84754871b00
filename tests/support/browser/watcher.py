"""A client without a browser that follows the live link: what the cell does, as somebody else is told."""

import json
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from websockets.exceptions import ConnectionClosed

from tests.support.console.server import Browser


class Watcher:
    """Keeps the newest state and when it came; a context that leaves the link at its end."""

    def __init__(self, link: str) -> None:
        self.state: dict[str, Any] = {}
        self._changed = threading.Condition()
        self._link = Browser(link).live()

    def _hear(self) -> None:
        with suppress(ConnectionClosed):
            for message in self._link:
                if isinstance(message, str) and (said := json.loads(message))["type"] == "state":
                    with self._changed:
                        self.state = said
                        self._changed.notify_all()

    def __enter__(self) -> "Watcher":
        threading.Thread(target=self._hear, daemon=True).start()
        self.until(lambda state: True)
        return self

    def __exit__(self, *_: object) -> None:
        self._link.close()

    def until(self, holds: Callable[[dict[str, Any]], Any], timeout: float = 20.0) -> dict[str, Any]:
        """Wait for a state in which something holds, and give it."""
        with self._changed:
            found = self._changed.wait_for(lambda: self.state and holds(self.state), timeout)
            assert found, f"not within {timeout:g} s; last told: {json.dumps(self.state)[:1500]}"
            return self.state

    def still(self, reading: Callable[[dict[str, Any]], float], quiet: float = 0.2, timeout: float = 5.0) -> float:
        """Wait until a reading has not changed for `quiet` s; when it did last, by `time.monotonic`."""
        begin = last = time.monotonic()
        value = reading(self.state)
        while time.monotonic() - last < quiet:
            assert time.monotonic() - begin < timeout, f"it still moves after {timeout:g} s"
            with self._changed:
                self._changed.wait(0.1)
                now = reading(self.state)
            if abs(now - value) > 2e-5:
                value, last = now, time.monotonic()
        return last
