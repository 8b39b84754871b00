"""Child side: what goes to the owner, sent by a thread of its own.

An owner that computes may not read for a second, and its pipe fills: neither the thread that reads the arm nor the one
that commands it may wait for that, or the controller's watchdog ends the program of an arm that is perfectly well.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection

from drivers.arm.messages import ChildReply, Ended, Lost, Snapshot

Message = ChildReply | Ended | Snapshot | Lost


class ChildOutbox:
    """Sends messages in the order in which they were put; `on_gone` is called once when nobody takes them any more."""

    def __init__(self, pipe: Connection, on_gone: Callable[[], None]) -> None:
        self._pipe = pipe
        self._on_gone = on_gone
        self._messages: queue.SimpleQueue[Message | threading.Event] = queue.SimpleQueue()
        threading.Thread(target=self._run, name="outbox", daemon=True).start()

    def put(self, *messages: Message) -> None:
        """Have messages sent; never waits."""
        for message in messages:
            self._messages.put(message)

    def drain(self, seconds: float) -> None:
        """Wait until what was put so far is sent, at most `seconds` on the wall."""
        sent = threading.Event()
        self._messages.put(sent)
        sent.wait(seconds)

    def _run(self) -> None:
        gone = False
        while True:
            message = self._messages.get()
            if isinstance(message, threading.Event):
                message.set()
            elif not gone:
                try:
                    self._pipe.send(message)
                except OSError:
                    gone = True
                    self._on_gone()
