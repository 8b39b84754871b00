"""What the vehicle answers when it is asked for its version; descriptions of the protocol differ in how that goes.

The maker's SDK sends 01 to 0x4A1 and reads ten frames of text there. The SCOUT manual 1.3.0 asks at 0x411 and reads
four numbers at 0x41A. Some firmware answers neither: then the version is unknown, which is no fault.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

TEXT_REQUEST = (0x4A1, b"\x01")
"""Identifier and data of the SDK's request."""
ANSWERS = ("VersionResponse", "VersionNumbers")
UNKNOWN = "unknown"
_TEXT_FRAMES = 10
_NUMBERS = ("ControllerHardware", "DriverHardware", "ControllerSoftware", "DriverSoftware")
_PRINTABLE = frozenset((0, *range(32, 127)))


class VersionAnswer:
    """Collects the answer to one request, frame by frame."""

    def __init__(self) -> None:
        self._text: list[bytes] = []
        self._numbers: tuple[int, ...] | None = None

    def take(self, message: str, signals: Mapping[str, float]) -> None:
        """Take a frame of one of the `ANSWERS`."""
        numbers = tuple(int(signals[name]) for name in _NUMBERS)
        data = struct.pack(">4H", *numbers)
        # A text may be shorter than its frames: what follows it is zeros, and no numbers.
        if message == "VersionResponse" and all(byte in _PRINTABLE for byte in data) and (data[0] or self._text):
            self._text.append(data)
        elif not self._text or message == "VersionNumbers":
            self._numbers = numbers

    def is_complete(self) -> bool:
        """True once no more is to come."""
        return self._numbers is not None or len(self._text) >= _TEXT_FRAMES

    def describe(self) -> str:
        """The version in one line, or that it is unknown."""
        if len(self._text) >= _TEXT_FRAMES:
            text = b"".join(self._text[:_TEXT_FRAMES]).replace(b"\0", b" ").decode("ascii")
            return " ".join(text.split()) or UNKNOWN
        if self._numbers is None:
            return UNKNOWN
        controller, driver, software, drivers = self._numbers
        return f"hardware {controller}/{driver}, controller {software}, drivers {drivers}"
