"""What a terminal sends, as key events: plain keys, and pressed, repeated and released ones of the kitty protocol.

Source: "Comprehensive keyboard handling in terminals" (kitty), xterm's control sequences for status and focus reports.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

ASK_KEYBOARD = b"\x1b[?u"
"""Which of the protocol's flags are on: a terminal that knows it answers, others say nothing."""
ASK_STATUS = b"\x1b[5n"
"""Every terminal answers this; an answer shows that somebody is there now."""
PUSH, POP = b"\x1b[>11u", b"\x1b[<u"
"""Flags 1, 2 and 8: escape codes for all keys, with what happened to them; and back to what was before."""
RELEASES = 2
"""The flag without which a terminal reports no release."""
FOCUS_ON, FOCUS_OFF = b"\x1b[?1004h", b"\x1b[?1004l"

Event = Literal["press", "repeat", "release"]
_EVENTS: dict[int, Event] = {1: "press", 2: "repeat", 3: "release"}
_CONTROL = 4
"""Bit of the modifiers less one."""
_LETTERS = {"A": "up", "B": "down", "C": "right", "D": "left"}
_CODES = {27: "escape", 13: "enter", 9: "tab", 32: "space", 127: "backspace"}
_SEQUENCE = re.compile(rb"\x1b\[([?<>=]?)([0-9:;]*)([@-~])|\x1bO([A-D])")
_UNFINISHED = re.compile(rb"\x1b(\[[?<>=]?[0-9:;]*)?$|\x1bO$")
LONGEST = 64
"""Bytes of a sequence that is waited for; more of them are thrown away."""


@dataclass(frozen=True)
class Key:
    """A key by its name: a character, or left, right, up, down, escape, enter, tab, space; `ctrl-c` and the like."""

    name: str
    event: Event = "press"


@dataclass(frozen=True)
class Keyboard:
    """The answer to `ASK_KEYBOARD`."""

    flags: int


@dataclass(frozen=True)
class Status:
    """The answer to `ASK_STATUS`."""


@dataclass(frozen=True)
class Focus:
    """The terminal's window has got or lost the keyboard."""

    here: bool


Heard = Key | Keyboard | Status | Focus


class Decoder:
    """Bytes in, events out; what is cut off waits for the rest."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Heard]:
        """The events in `data`, in their order."""
        data, self._rest = self._rest + data, b""
        heard: list[Heard] = []
        at = 0
        while at < len(data):
            if found := _SEQUENCE.match(data, at):
                heard += _read(found)
                at = found.end()
            elif len(data) - at < LONGEST and _UNFINISHED.match(data, at):
                self._rest = data[at:]
                break
            else:
                heard += _plain(data[at])
                at += 1
        return heard

    def flush(self) -> list[Heard]:
        """What waits, when nothing follows it: an escape that was a key by itself."""
        rest, self._rest = self._rest, b""
        return [Key("escape")] if rest == b"\x1b" else []


def _plain(byte: int) -> list[Heard]:
    if name := _CODES.get(byte):
        return [Key(name)]
    if byte < 27:
        return [Key(f"ctrl-{chr(byte + 96)}")]
    return [Key(chr(byte))] if 32 < byte < 127 else []


def _read(found: re.Match[bytes]) -> list[Heard]:
    if found[4]:
        return [Key(_LETTERS[found[4].decode()])]
    mark, last = found[1], found[3].decode()
    fields = [[int(part) if part else 0 for part in field.split(b":")] for field in found[2].split(b";")]
    if mark == b"?" and last == "u":
        return [Keyboard(fields[0][0])]
    if mark:
        return []
    if last in ("I", "O") and not found[2]:
        return [Focus(last == "I")]
    if last == "n":
        return [Status()] if fields == [[0]] else []
    modifiers, *event = fields[1] if len(fields) > 1 else [1]
    happened = _EVENTS.get(event[0] if event else 1)
    if happened is None:
        return []
    if last in _LETTERS:
        return [Key(_LETTERS[last], happened)]
    code = fields[0][0]
    if last != "u" or not (name := _CODES.get(code) or (chr(code) if 32 < code < 127 else "")):
        return []
    return [Key(f"ctrl-{name}" if max(modifiers - 1, 0) & _CONTROL else name, happened)]
