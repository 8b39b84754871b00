"""A terminal in raw mode: its keys, whether it reports a key's release, whether it still answers, and what it shows.

It is asked `ASK_STATUS` again and again: an answer shows that the terminal, and whatever link leads to it, is alive,
and how long the way there and back takes. One question is under way at a time, so that an answer has its question.
"""

from __future__ import annotations

import os
import select
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from cell.terminal.keys import (
    ASK_KEYBOARD,
    ASK_STATUS,
    FOCUS_OFF,
    FOCUS_ON,
    POP,
    PUSH,
    RELEASES,
    Decoder,
    Heard,
    Key,
    Keyboard,
    Status,
)

ANSWER_S = 0.4
"""How long a terminal is waited for that is asked what it can do."""
ASK_EVERY_S = 0.04
ESCAPE_S = 0.05
"""After which an escape by itself is a key."""
_SHOW, _HIDE = b"\x1b[?25h", b"\x1b[?25l"
_OTHER, _BACK = b"\x1b[?1049h", b"\x1b[?1049l"


class TerminalGone(Exception):
    """The terminal was closed, or its process died."""


class Screen:
    """The terminal at the files `source` and `sink`; made by `opened`."""

    def __init__(self, source: int, sink: int) -> None:
        self.releases = False
        """Whether it reports when a key is let go of."""
        self.trip_s: float | None = None
        """Newest way there and back, None until it has answered."""
        self._source, self._sink = source, sink
        self._decoder = Decoder()
        self._asked: float | None = None
        self._next = 0.0
        self._shown: list[str] = []

    def read(self, seconds: float) -> list[Heard]:
        """What was heard within `seconds`, at once when something comes. Raises `TerminalGone`."""
        if not select.select([self._source], [], [], seconds)[0]:
            return list(self._decoder.flush()) if seconds >= ESCAPE_S else []
        try:
            data = os.read(self._source, 4096)
        except OSError as error:
            raise TerminalGone(f"the terminal is gone: {error.strerror}") from error
        if not data:
            raise TerminalGone("the terminal was closed")
        heard = self._decoder.feed(data)
        if any(isinstance(entry, Status) for entry in heard) and self._asked is not None:
            self.trip_s = time.monotonic() - self._asked
            self._asked = None
            self._next = time.monotonic() + ASK_EVERY_S
        return heard

    def ask(self) -> None:
        """Ask for a sign of life, unless a question is under way or the last one was just now."""
        if self._asked is None and time.monotonic() >= self._next:
            self._asked = time.monotonic()
            self.write(ASK_STATUS)

    @property
    def silent_s(self) -> float:
        """How long the question that is under way has had no answer; 0 for a terminal that never answered."""
        return 0.0 if self._asked is None or self.trip_s is None else time.monotonic() - self._asked

    def write(self, data: bytes) -> None:
        """Write to the terminal. Raises `TerminalGone`."""
        try:
            while data:
                data = data[os.write(self._sink, data) :]
        except OSError as error:
            raise TerminalGone(f"the terminal is gone: {error.strerror}") from error

    def show(self, lines: Sequence[str]) -> None:
        """Show these lines from the top, as many as there is room for; only what has changed is written."""
        try:
            width, height = os.get_terminal_size(self._sink)
        except OSError as error:
            raise TerminalGone(f"the terminal is gone: {error.strerror}") from error
        width, height = width or 80, height or 24
        kept = [line[:width] for line in lines[:height]]
        out = b""
        for row in range(max(len(kept), len(self._shown))):
            line = kept[row] if row < len(kept) else ""
            if row >= len(self._shown) or self._shown[row] != line:
                out += f"\x1b[{row + 1};1H{line}\x1b[K".encode()
        self._shown = kept
        if out:
            self.write(out)

    def begin(self) -> None:
        """Find out what the terminal can do, and have it report what is needed."""
        self.write(_OTHER + b"\x1b[2J" + _HIDE + FOCUS_ON)
        if self._flags() is not None:
            self.write(PUSH)
            self.releases = bool((self._flags() or 0) & RELEASES)

    def end(self) -> None:
        """Leave it as it was."""
        with suppress(TerminalGone):
            self.write((POP if self.releases else b"") + FOCUS_OFF + _SHOW + _BACK)

    def _flags(self) -> int | None:
        """The keyboard's flags; None where the terminal has no answer but the one that all have, or none at all."""
        self._asked = time.monotonic()
        self.write(ASK_KEYBOARD + ASK_STATUS)
        end, flags = self._asked + ANSWER_S, None
        while (left := end - time.monotonic()) > 0:
            heard = self.read(left)
            flags = next((entry.flags for entry in heard if isinstance(entry, Keyboard)), flags)
            if any(isinstance(entry, Status) for entry in heard):
                break
        return flags


@contextmanager
def opened(source: int, sink: int) -> Iterator[Screen]:
    """The terminal in raw mode, as it was afterwards. Ctrl-C is a key, or ends the program as elsewhere."""
    before = termios.tcgetattr(source)
    screen = Screen(source, sink)
    try:
        tty.setcbreak(source)
        screen.begin()
        yield screen
    finally:
        screen.end()
        with suppress(termios.error):
            termios.tcsetattr(source, termios.TCSADRAIN, before)


def quits(heard: Heard) -> bool:
    """Whether somebody wants to leave."""
    return isinstance(heard, Key) and heard.event == "press" and heard.name in ("q", "escape", "ctrl-c")
