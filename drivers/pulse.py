"""The sign of life that this process sends to the processes that stop its devices when it is frozen."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress

from drivers.errors import CellError

BEAT_S = 0.05
"""Wall seconds between two beats; `last_words_child.FROZEN_S` allows four of them to be lost."""
_NICENESS = -10


class Pulse:
    """Calls `beat` every `BEAT_S` on a thread of its own until `close`, or until `beat` fails because nobody listens.

    The thread runs before others where the system allows it.
    """

    def __init__(self, name: str, beat: Callable[[], None]) -> None:
        self._beat = beat
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """No beat comes after this; idempotent."""
        self._closed.set()
        if self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def _run(self) -> None:
        # Linux has a niceness for each thread.
        with suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        with suppress(OSError, CellError):
            while not self._closed.is_set():
                self._beat()
                self._closed.wait(BEAT_S)
